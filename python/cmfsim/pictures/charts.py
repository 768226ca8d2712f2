"""Box plots of errors, as Kim et al. (2010) show them in Figure 9. Needs matplotlib."""

import io
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.errors import CaseInputError
from cmfsim.pictures.canvas import write_whole
from cmfsim.values.checks import AnyPath, as_floats

# By model, in the order of the paper; told apart in grey too.
MODEL_COLOURS = {
    "no change": "#c9c5bd", "H": "#f0c987", "M": "#d98a4b", "H+S": "#b5d3e8", "M+S": "#5b9bc9",
}  # fmt: skip
OTHER_COLOURS = ("#8fae7a", "#b58db6", "#d9798b", "#6f6f6f")
SUFFIXES = (".png", ".svg", ".pdf")
# Error that is called acceptable in most of the literature, mm.
ACCEPTABLE = 2.0
# Of a chart, inches.
HEIGHT = 4.5
# Width of a group of boxes, of the distance between groups.
GROUP = 0.8


def chart_errors(
    path: AnyPath, errors: Mapping[str, Mapping[str, ArrayLike]], *, width: float = 8.0
) -> None:
    """Writes a box plot of |distance|: a group for each patient or region, a box for each model.

    A box runs from the lower to the upper quartile with a line at the median and a diamond at the
    mean; whiskers reach to the last value within 1.5 boxes, and what lies beyond is drawn as dots
    and, above the box, counted.

    path: Ends in `.png`, `.svg` or `.pdf`.
    errors: mapping of str to mapping of str to (k,), mm, by patient (or region), then by model:
        signed distances or their sizes.
    width: inches.
    Raises `CaseError`: matplotlib is missing, nothing to draw, NaN, another ending.

    Examples
    --------
    >>> import cmfsim.pictures
    >>> cmfsim.pictures.chart_errors(
    ...     "errors.svg", {"P1": first.errors, "P2": second.errors}
    ... )  # doctest: +SKIP
    """
    groups = {
        group: {m: np.abs(as_floats(f"errors of {group}, {m}", v)) for m, v in models.items()}
        for group, models in errors.items()
    }
    models = list(dict.fromkeys(m for by_model in groups.values() for m in by_model))
    if not models:
        raise CaseInputError("there are no errors to draw")
    for group, by_model in groups.items():
        for model, values in by_model.items():
            if values.ndim != 1 or not len(values):
                raise CaseInputError(f"errors of {group}, {model} have shape {values.shape}: (k,)")
    others = iter(OTHER_COLOURS * (1 + len(models) // len(OTHER_COLOURS)))
    colours = {m: MODEL_COLOURS[m] if m in MODEL_COLOURS else next(others) for m in models}
    write_figure(Path(path), (width, HEIGHT), lambda figure: _draw(figure, groups, colours))


def write_figure(
    path: Path, size: tuple[float, float], draw: Callable[[Any], None], *, dpi: int = 150
) -> None:
    """Writes what `draw` puts into an empty figure of matplotlib; an old file goes in one step.

    path: Ends in `.png`, of so many dots per inch, `.svg` or `.pdf`; size in inches.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise CaseInputError(
            f"{path.name}: a chart is written as {', '.join(SUFFIXES)}, not {path.suffix!r}"
        )
    try:
        matplotlib = import_module("matplotlib")
        figures = import_module("matplotlib.figure")
    except ImportError as error:
        raise CaseInputError(
            f"charts are drawn with matplotlib, which cannot be imported ({error}): "
            "pip install '.[report]' in cmfsim's folder"
        ) from error
    # Text stays text in SVG, and ids and dates do not change from run to run.
    settings = {"svg.fonttype": "none", "svg.hashsalt": "cmfsim", "font.size": 9.0}
    with matplotlib.rc_context(settings):
        figure = figures.Figure(figsize=size, layout="constrained")
        draw(figure)
        file = io.BytesIO()
        kind = path.suffix.lower()[1:]
        metadata = {"png": {"Software": None}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}
        figure.savefig(file, format=kind, dpi=dpi, metadata=metadata[kind])
    write_whole(path, file.getvalue())


def _draw(figure: Any, groups: Mapping[str, Mapping[str, Any]], colours: Mapping[str, str]) -> None:
    axes = figure.add_subplot()
    _boxes(axes, groups, colours)
    patch = import_module("matplotlib.patches").Patch
    handles = [patch(facecolor=c, edgecolor="black", label=m) for m, c in colours.items()]
    place = {"loc": "upper center", "bbox_to_anchor": (0.5, 1.14), "ncols": len(handles)}
    axes.legend(handles=handles, frameon=False, **place)


def _boxes(axes: Any, groups: Mapping[str, Mapping[str, Any]], colours: Mapping[str, str]) -> None:
    step = GROUP / len(colours)
    mean = {
        "marker": "D", "markersize": 3.0, "markerfacecolor": "white", "markeredgecolor": "black",
        "markeredgewidth": 0.7,
    }  # fmt: skip
    beyond = {
        "marker": ".", "markersize": 1.5, "markeredgecolor": "#555555", "alpha": 0.4,
        "rasterized": True,
    }  # fmt: skip
    for number, by_model in enumerate(groups.values()):
        for place, (model, colour) in enumerate(colours.items()):
            if model not in by_model:
                continue
            at = number + (place - 0.5 * (len(colours) - 1)) * step
            drawn = axes.boxplot(
                by_model[model],
                positions=[at],
                widths=0.8 * step,
                patch_artist=True,
                showmeans=True,
                manage_ticks=False,
                boxprops={"facecolor": colour, "linewidth": 0.8},
                medianprops={"color": "black", "linewidth": 1.2},
                whiskerprops={"linewidth": 0.8},
                capprops={"linewidth": 0.8},
                meanprops=mean,
                flierprops=beyond,
            )
            # As the statistics count them: the low ones are the good ones.
            fliers = drawn["fliers"][0].get_ydata()
            outliers = fliers[fliers > np.median(by_model[model])]
            if len(outliers):
                axes.annotate(
                    str(len(outliers)),
                    (at, max(outliers)),
                    xytext=(0, 3),
                    textcoords="offset points",
                    ha="center",
                    fontsize=6.5,
                    color="#555555",
                )
    axes.axhline(ACCEPTABLE, color="#999999", linewidth=0.8, linestyle=(0, (4, 3)), zorder=0)
    axes.set_xticks(range(len(groups)), list(groups))
    axes.set_xlim(-0.5, len(groups) - 0.5)
    axes.set_ylim(bottom=0.0)
    axes.margins(y=0.08)
    axes.set_ylabel("|distance| to the post-operative skin, mm")
    axes.spines[["top", "right"]].set_visible(False)
