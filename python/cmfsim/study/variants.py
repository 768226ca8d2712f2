"""A cohort under several settings: the error of each patient, and its change by each variant."""

import json
import logging
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from cmfsim.errors import CaseInputError, CmfsimError
from cmfsim.evaluation.models import NO_CHANGE, ErrorTable
from cmfsim.evaluation.statistics import PairedChange, paired_change
from cmfsim.io import AS_GIVEN, Case, CaseChanges, Cohort, Variants
from cmfsim.pipeline.building.case_model import kind_options_of
from cmfsim.pipeline.building.inputs import case_key, input_hashes
from cmfsim.pipeline.outputs.results import write_report_page
from cmfsim.report.variants import variants_document, variants_markdown, variants_text
from cmfsim.study.cohort import (
    CaseOutcome,
    StudyOptions,
    StudyReport,
    replacing_all,
    run_studies,
    study_table,
)
from cmfsim.values.table import csv_of

_log = logging.getLogger(__name__)

VARIANTS_JSON, VARIANTS_CSV, VARIANTS_TEXT = "variants.json", "variants.csv", "variants.md"
FILES = re.compile(r"variants\.(json|csv|md)|report\.html")


@dataclass(frozen=True, eq=False)
class VariantsReport:
    """The outcome of every variant for every case.

    Attributes
    ----------
    cohort : Cohort
    variants : Variants
    reports : mapping of str to StudyReport
        By variant.
    same : mapping of str to frozenset of str
        By variant, the cases that were not repeated: nothing changes for them, or they cannot be
        read at all.
    seconds : float
    """

    cohort: Cohort
    variants: Variants
    reports: Mapping[str, StudyReport]
    same: Mapping[str, frozenset[str]]
    seconds: float

    @property
    def failed(self) -> tuple[tuple[str, CaseOutcome], ...]:
        """Variant and outcome of each case that failed."""
        return tuple(
            (name, case) for name, report in self.reports.items() for case in report.failed
        )

    @property
    def output(self) -> Path:
        """The folder of all results: one of each variant, and in it one of each case."""
        return _folder(self.cohort, self.variants)

    def tables(self) -> dict[str, ErrorTable]:
        """The errors of each variant in which a case was compared."""
        return {
            name: study_table(report)
            for name, report in self.reports.items()
            if any(outcome.evaluation for outcome in report.outcomes)
        }

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON; all errors in mm."""
        tables = self.tables()
        return {
            "cohort": self.cohort.name,
            "note": self.cohort.note,
            "description": self.variants.description,
            "models": list(self.variants.models),
            "patients": list(self.cohort.cases),
            "seconds": self.seconds,
            "variants": [self._described(name) for name in self.reports],
            "rows": list(_rows(tables)),
            "changes": [
                {"variant": variant, "model": model, "region": region, **change.as_dict()}
                for (variant, model, region), change in _changes(tables).items()
            ],
        }

    def text(self) -> str:
        """The tables as plain text; the short ones over all regions come last."""
        return variants_text(self.as_dict())

    def _described(self, name: str) -> dict[str, Any]:
        variant, report = self.variants.variants[name], self.reports[name]
        made = variant.changes or CaseChanges({})
        same = self.same[name]
        ours = {
            o.name: set(o.evaluation.get("warnings", ())) for o in self.reports[AS_GIVEN].outcomes
        }
        return {
            "name": name,
            "description": variant.description,
            "words": variant.words,
            "values": dict(made.values),
            "without": list(made.without),
            "models": list(variant.models),
            "same": sorted(same),
            "cases": [
                {
                    **{k: v for k, v in asdict(outcome).items() if k != "evaluation"},
                    # Of a variant, what the cases as given do not have as well.
                    "warnings": [
                        warning
                        for warning in outcome.evaluation.get("warnings", ())
                        if name == AS_GIVEN or warning not in ours[outcome.name]
                    ],
                }
                for outcome in report.outcomes
            ],
        }


def run_variants(
    cohort: Cohort,
    variants: Variants,
    *,
    options: StudyOptions | None = None,
    progress: Callable[[str, CaseOutcome], None] | None = None,
) -> VariantsReport:
    """Every case of a cohort as given and with each variant's changes of settings.

    Every variant is applied to every case before anything runs. Results lie in the folder
    `study-variants/VARIANT/CASE`, if the file is called `variants.toml`; a later run keeps those
    whose inputs, settings, models and version are the same. A case in which a variant changes
    nothing, because it names the default, is not repeated.

    Parameters
    ----------
    cohort : Cohort
    variants : Variants
    options : StudyOptions, optional
        Number of workers, cluster, and whether finished cases are repeated.
    progress : callable, optional
        Called with variant and outcome as soon as it is known.

    Raises
    ------
    CaseError
        (also `ValueError`) A key or value that a case cannot have, with its place in the file of
        the variants; as `run_study`.
    OSError
        The output folder cannot be made or written to.

    Examples
    --------
    >>> import cmfsim
    >>> cohort = cmfsim.Cohort.load("cohort.toml")  # doctest: +SKIP
    >>> variants = cmfsim.Variants.load("variants.toml", cohort.models)  # doctest: +SKIP
    >>> report = cmfsim.run_variants(cohort, variants)  # doctest: +SKIP
    """
    same = _same_as_given(cohort, variants)
    cohorts = {
        name: replace(
            cohort,
            output=_folder(cohort, variants) / name,
            models=variant.models,
            changes=variant.changes,
            cases={n: file for n, file in cohort.cases.items() if n not in same[name]},
        )
        for name, variant in variants.variants.items()
        if len(same[name]) < len(cohort.cases)
    }
    name_of = {id(changed): name for name, changed in cohorts.items()}

    def say(changed: Cohort, outcome: CaseOutcome) -> None:
        if progress is not None:
            progress(name_of[id(changed)], outcome)

    reports = run_studies(list(cohorts.values()), options or StudyOptions(), progress=say)
    ran = dict(zip(cohorts, reports, strict=True))
    given = {outcome.name: outcome for outcome in ran[AS_GIVEN].outcomes}
    whole = {}
    for name, variant in variants.variants.items():
        own = {o.name: o for o in ran[name].outcomes} if name in ran else {}
        outcomes = tuple(own.get(case, given[case]) for case in cohort.cases)
        changed = replace(cohort, models=variant.models, changes=variant.changes)
        whole[name] = StudyReport(changed, outcomes, reports[0].seconds)
    return VariantsReport(cohort, variants, whole, same, reports[0].seconds)


def _folder(cohort: Cohort, variants: Variants) -> Path:
    """The folder of a file of variants, beside the results of the plain study."""
    return cohort.output.with_name(f"{cohort.output.name}-{variants.file.stem}")


def _same_as_given(cohort: Cohort, variants: Variants) -> dict[str, frozenset[str]]:
    """By variant, the cases with the settings of "as-given", and those that cannot be read."""
    same: dict[str, set[str]] = {name: set() for name in variants.variants}
    for name, file in cohort.cases.items():
        try:
            given = _settings(Case.load(file))
        except (CmfsimError, OSError) as error:
            # Not the fault of a variant: the case fails as given.
            _log.debug("%s: %s", name, error)
            for label in same.keys() - {AS_GIVEN}:
                same[label].add(name)
            continue
        for label, variant in variants.variants.items():
            if variant.changes is None:
                continue
            try:
                changed = _settings(Case.load(file, changes=variant.changes))
            except (CaseInputError, FileNotFoundError) as error:
                raise CaseInputError(f"{error} (variant {label!r}, case {name!r})") from error
            if changed == given:
                same[label].add(name)
    return {name: frozenset(cases) for name, cases in same.items()}


def _settings(case: Case) -> str:
    """The key of a case in which options of nodes that are not stated have their defaults."""
    options = asdict(kind_options_of(case))
    return case_key(replace(case, node_kinds=options), input_hashes(case))


def _rows(tables: Mapping[str, ErrorTable]) -> Iterator[dict[str, Any]]:
    """The mean error of each patient, region, model and variant, next to that as given, mm."""
    given = tables.get(AS_GIVEN)
    for variant, table in tables.items():
        for (patient, region, model), cell in table.cells.items():
            if model == NO_CHANGE and variant != AS_GIVEN:
                continue
            before = None if given is None else given.cells.get((patient, region, model))
            yield {
                "patient": patient,
                "region": region,
                "model": model,
                "variant": variant,
                "mean_mm": cell.mean,
                "as_given_mm": None if before is None else before.mean,
                "change_mm": None if before is None else cell.mean - before.mean,
            }


def _changes(tables: Mapping[str, ErrorTable]) -> dict[tuple[str, str, str], PairedChange]:
    """By variant, model and region, the change over the patients for whom both succeeded."""
    found: dict[tuple[str, str, str], PairedChange] = {}
    given = tables.get(AS_GIVEN)
    if given is None:
        return found
    for variant, table in tables.items():
        if variant == AS_GIVEN:
            continue
        for model in (model for model in table.models if model != NO_CHANGE):
            for region in table.regions:
                keys = [(patient, region, model) for patient in table.patients]
                pairs = [
                    (given.cells[key].mean, table.cells[key].mean)
                    for key in keys
                    if key in given.cells and key in table.cells
                ]
                if pairs:
                    first, second = zip(*pairs, strict=True)
                    found[variant, model, region] = paired_change(first, second)
    return found


def write_variants_report(report: VariantsReport) -> list[str]:
    """The names of the files of a study of variants, written together into its folder.

    `variants.csv` (a row for each patient, region, model and variant), `variants.md` (tables for
    reading), `variants.json` (both, with intervals and tests) and `report.html`. Without Jinja2,
    the last is missing, with a warning.

    Raises
    ------
    OSError
        The folder cannot be written to.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.write_variants_report(report)  # doctest: +SKIP
    ['variants.csv', 'variants.md', 'variants.json', 'report.html']
    """
    folder, values = report.output, report.as_dict()

    def fill(fresh: Path) -> list[str]:
        names = [VARIANTS_TEXT, VARIANTS_JSON]
        if values["rows"]:
            (fresh / VARIANTS_CSV).write_text(csv_of(values["rows"]), encoding="utf-8")
            names.insert(0, VARIANTS_CSV)
        (fresh / VARIANTS_TEXT).write_text(variants_markdown(values), encoding="utf-8")
        text = json.dumps(values, indent=1, allow_nan=False, ensure_ascii=False)
        (fresh / VARIANTS_JSON).write_text(text + "\n", encoding="utf-8")
        page = write_report_page(fresh, variants_document(values))
        return [*names, *([] if page is None else [page])]

    return replacing_all(folder, FILES, fill)
