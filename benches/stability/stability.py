"""The stiff and extreme suite: every method against references that are not cmfsim.

    python -m benches.stability.stability [--markdown docs/stability.md] [--json out.json] [--quick]

solves each case with each method and writes a table with the condition number, the residual, the
error against a closed form or an independent solution, and a verdict. The exit status is 1 if any
verdict is not the expected one. The cases are in `benches/stability/extreme/`, one module per
subject. Needs scipy and scikit-fem beside numpy and cmfsim.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from benches.stability.extreme import contact, elements, kinematics, linear
from benches.stability.extreme.contact import DISTANCE, TANGENTIAL
from benches.stability.extreme.contact import ERROR as CONTACT_ERROR
from benches.stability.extreme.elements import LOCKED
from benches.stability.extreme.rows import (
    BOUND_FACTOR,
    CONDITION_FACTOR,
    ERROR_LIMIT,
    SWEEPS,
    WORTHLESS,
)

if TYPE_CHECKING:
    from types import ModuleType

    from benches.stability.extreme.rows import Row

# Each has `cases`, `judge`, `forget`, and the `COLUMNS` of its table.
SUITES: tuple[ModuleType, ...] = (linear, contact, elements, kinematics)

# What a column shows of a row, by its heading.
FIGURES = {
    "κ": "condition",
    "residual": "residual",
    "true residual": "true_residual",
    "error": "error",
    "estimate": "error_estimate",
    "distance, mm": "distance",
    "tangential": "tangential",
    "least J": "least_volume",
    "deflection": "deflection",
}

INTRODUCTION = f"""# Numerical stability: the stiff and extreme suite

`python -m benches.stability.stability --markdown docs/stability.md` writes this page;
`tests/python/core/test_extreme.py` runs the linear cases and the quicker ones of the others.
Numbers near 1e-15 differ from machine to machine.

## How to read the tables

- **condition** is the extreme value of the case.
- **κ** is the condition number κ₂ of D^-½ K D^-½ over the unknowns, where K is the stiffness and D
  its diagonal. It bounds the error of Cholesky factorisation (van der Sluis 1969). Moduli in
  another unit, or a stiff layer on a soft one, do not raise it; a stiff body attached only through
  soft tissue does.
- **reference** is never cmfsim. *Closed form*: a field that the mesh can represent (affine, rigid,
  piecewise linear in layers), so the discrete answer equals the analytical one. *32 digits*:
  `benches/scenes/extended.py` builds elasticity from the engineering compliance with 60 decimal
  digits, sums forces tet by tet in pairs of float64 (Dekker 1971), and refines until the last
  correction is below 1e-18 of the displacements; the tests compare it with the closed forms and
  with a solution in exact fractions. *Mechanism*: there is no solution, and the case must be
  refused.
- **residual** is `result.residual`: the out-of-balance forces relative to the forces that the plan
  introduces. It is compared with the residual in 32 digits. Where κ is large, it says little about
  the error.
- **error** is the largest distance of a node from its reference position, relative to the largest
  displacement.
- **estimate** is `result.error_estimate` relative to the largest displacement. It is not a bound
  ([error estimates](error_estimates.md)).
- **verdict** is *ok*, *refused* with the error raised, or **WRONG**.

A result is *ok* under these conditions, with ε = 2.2e-16. The error of Cholesky is within the
larger of {ERROR_LIMIT:.0e} and {CONDITION_FACTOR:g} ε κ. The error of `pcg` and `relaxation` is
within {BOUND_FACTOR:g} × their estimate plus {CONDITION_FACTOR:g} ε κ, because the estimates are of
the equations in float64, whose own rounding is of the order ε κ. These allowances never exceed
{WORTHLESS:.0e}. A solvable case may be refused (`SolverError`) by Cholesky where
{CONDITION_FACTOR:g} ε κ > {WORTHLESS:.0e}, by `pcg` where {CONDITION_FACTOR:g} ε κ exceeds the
requested tolerance (1e-9 unless stated), and by `relaxation` in the same place or where κ exceeds
the {SWEEPS} sweeps that it is given here.

*Contact*, *lift-off*, *contact tolerance*, *held by contact*: **distance** is the largest distance
between a node in contact and the place where it belongs, computed over the triangles of the moved
surface one by one. **Tangential** is the largest force across the normals, relative to the largest
contact force. **True residual** is that of the tangential equilibrium in 32 digits, and **error**
is the distance from the displacements in that equilibrium with the same places and normals
(`benches/stability/extreme/contact.py`), whose κ is that of the tangential unknowns. *Ok* means a
distance within {DISTANCE:.0e} mm (twice the contact tolerance where that is wider), a tangential
force within {TANGENTIAL:.0e}, an error within {CONTACT_ERROR:.0e}, normals equal to those of
the wall, and no tension with lift-off.

*Bending* and *elements*: the error is measured from the solution of an independent stiffness of the
same element (`benches/scenes/independent.py`: scikit-fem; numpy for `anp`), and the residual is
that of this stiffness relative to |K| |u|. **Deflection** is the deflection of the tip relative to
scikit-fem's quadratic tets of half the edge. It shows the effect of the mesh, while the other
columns show the effect of the solver. An element *locks* if its deflection is below {LOCKED:g} of
its own at ν = 0.3.

*Large deformation*: **true residual** is that of forces which scikit-fem assembles from stresses
computed in numpy, relative to those at the constrained nodes. **Error** is the step that these
forces would still cause with the tangent of cmfsim, or the distance from the closed form.
**Least J** is the smallest ratio of a tet's volume to its volume at rest.

## Where a method must not be used

- **cholesky** loses log10 κ of its 16 digits, so an answer at a κ of 1e12 (a bar 1000 times as long
  as thick) has four, as `result.error_estimate` reports. Not far above that, it is refused.
- **pcg**: where κ is above about 1e7, that is, for stiff tissue attached through soft tissue at a
  contrast above 1e6, and for slender bodies. Rounding then keeps it from reaching its tolerance,
  and it raises `SolverError`.
- **relaxation**: stiff bodies in soft tissue at a contrast above 1e2, ν above 0.49, slivers. It
  runs out of sweeps and raises `SolverError`. It measures its error by conjugate gradients, so it
  is refused wherever these are.
- **pcg** with `p2`: κ is about twenty times that of linear tets, and it is refused correspondingly
  sooner.
- **p1**: bending tissue with ν above 0.45. It locks without a warning. `anp` and `p2` do not
  (theory, *Elements*), although `anp` keeps only two thirds of its deflection on a beam two boxes
  thick.
- **corotational**: a body compressed to about half its length. The energy is finite where a tet
  inverts, so tets may be inverted at equilibrium; `hyperelastic` resists inversion, or is refused.
  `solve_scene` and `predict` warn of it (`inverted-tets`: how many, and which is worst) and
  count them in the summary. After `StaticSolver.solve`, look for
  `tensors.volume_change(u) <= -1`.
- **contact** in a groove of 10° across which the body is pushed may not converge. It raises
  `ContactError` with the nodes. A body constrained only by walls is refused if they leave a
  motion free.
- **relaxation** and **plan_operator** with `corotational` or `hyperelastic`: they belong to the
  linear model and raise `SolverError`. So does a plan for which Newton's method does not converge
  in 64 parts.
- Constrained nodes that lie within about 1e-4 of the body's size of one line count as collinear:
  `BoundaryError`.
"""


def table(suite: ModuleType, rows: list[Row]) -> str:
    """The rows of a suite as Markdown tables; methods that refuse a case alike share a line."""
    out = []
    headings = ["case", "condition", "reference", "method", *suite.COLUMNS, "verdict"]
    for group in dict.fromkeys(r.group for r in rows):
        out += [
            f"## {group[0].upper()}{group[1:]}",
            "",
            "| " + " | ".join(headings) + " |",
            "|" + "---|" * len(headings),
        ]
        members = [r for r in rows if r.group == group]
        for _, alike in itertools.groupby(members, key=_line):
            same = list(alike)
            r = same[0]
            figures = [_figure(r, heading) for heading in suite.COLUMNS]
            methods = ", ".join(other.method for other in same)
            cells = [r.name, r.parameter, r.reference, methods, *figures, _verdict(r)]
            out.append("| " + " | ".join(cells) + " |")
        out.append("")
    return "\n".join(out)


def _figure(row: Row, heading: str) -> str:
    # The estimate of a direct solve is rounding, and differs from machine to machine.
    if heading == "estimate" and row.method == "cholesky":
        return "–"
    value = getattr(row, FIGURES[heading])
    if heading in ("least J", "deflection") and value is not None:
        return f"{value:.2f}"
    return cell(value)


def _line(row: Row) -> tuple[str, ...]:
    """What rows that share a line have in common: solved ones share with none."""
    method = row.method if row.error is not None else ""
    return (row.name, row.parameter, method, _verdict(row))


def _verdict(row: Row) -> str:
    """The verdict without the advice at the end of a message."""
    text = row.verdict
    for advice in ("; use ", "; fix or join", "; a part of the body may"):
        text = text.split(advice)[0]
    if not row.passed:
        text = f"**{text}**"
    return text.replace("|", "\\|")


def cell(value: float | None) -> str:
    """A figure of the table."""
    return "–" if value is None else f"{value:.1e}"


def main(arguments: list[str] | None = None) -> int:
    """Runs the suite; 1 if any verdict is not the wanted one."""
    parser = argparse.ArgumentParser(description="stiff and extreme cases against references")
    parser.add_argument("--markdown", type=Path, help="file for the table with its introduction")
    parser.add_argument("--json", type=Path, help="file for the rows")
    parser.add_argument("--quick", action="store_true", help="leave the larger cases out")
    parser.add_argument("--only", default="", help="run the cases whose name holds this text")
    parser.add_argument("-q", "--quiet", action="store_true", help="no line per solve")
    options = parser.parse_args(arguments)
    rows: list[Row] = []
    tables = []
    for suite in SUITES:
        found = []
        for case in suite.cases(quick=options.quick):
            if options.only not in case.key:
                continue
            for method in case.methods:
                row = suite.judge(case, method)
                found.append(row)
                if options.quiet:
                    continue
                figures = " ".join(
                    f"{heading} {_figure(row, heading)}" for heading in suite.COLUMNS
                )
                print(
                    f"{case.key:60.60} {method:10} {figures} it {row.iterations} "
                    f"{row.seconds:6.2f} s  {row.verdict}",
                    flush=True,
                )
            suite.forget()
        tables.append(table(suite, found))
        rows += found
    failed = [r for r in rows if not r.passed]
    if options.json:
        options.json.write_text(json.dumps([asdict(r) for r in rows], indent=1) + "\n")
    if options.markdown:
        text = "\n".join([INTRODUCTION, *(t for t in tables if t)])
        options.markdown.write_text(text, encoding="utf-8")
    print(f"{len(rows)} solves, {len(failed)} not as wanted")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
