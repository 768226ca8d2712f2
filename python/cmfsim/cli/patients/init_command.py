"""`cmfsim init`: a commented case file for the files in a folder."""

import argparse
import json
import sys

from cmfsim.cli.exit_codes import DONE
from cmfsim.cli.text.terminal import StageProgress, escaped
from cmfsim.drafting import CASE_FILE, init_case, read_moves


def init(options: argparse.Namespace) -> int:
    """Writes the case file, and reports the role assumed for each file."""
    with StageProgress(sys.stderr, quiet=options.quiet) as progress:
        draft = init_case(
            options.folder,
            force=options.force,
            cuts=options.cut,
            moves=read_moves(options.move),
            progress=progress.stage,
        )
    folder = options.folder if options.folder.is_dir() else options.folder.parent
    case = folder / CASE_FILE
    if options.json:
        print(json.dumps({"case": str(case), **draft.as_dict()}, allow_nan=False))
        return DONE
    for entry in draft.taken:
        is_open = entry.question or not entry.taken_for
        details = ", ".join(part for part in (entry.unit, entry.frame) if part)
        head = f"{entry.label}: {entry.taken_for or '?'}{f' ({details})' if details else ''}"
        print(f"{'? ' if is_open else '  '}{escaped(head)}")
        print(f"      {escaped(entry.why)}")
    print(f"case  {escaped(str(case))}")
    for question in draft.questions:
        print(f"decide  {escaped(question)}")
    print(f"next  cmfsim doctor {escaped(str(case))}")
    return DONE
