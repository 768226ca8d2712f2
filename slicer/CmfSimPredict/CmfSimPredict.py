#!/usr/bin/env python-real
"""CmfSimPredict CASE FACE.vtp [--model M] [--edge-length H]: `cmfsim predict` as a CLI module.

Slicer runs it outside of its own process, and reads the progress from standard output, as the
execution model has it. It works from a shell as well.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

NAME = "CmfSimPredict"
FACE = "Data/face_predicted.vtp"
# Stages of cmfsim and how far each is, for the progress bar.
STAGES = (
    ("checking", 0.02),
    ("reading", 0.10),
    ("segmenting", 0.15),
    ("measuring distances", 0.18),
    ("cutting", 0.30),
    ("finding the soft tissue", 0.35),
    ("filling the tissue", 0.40),
    ("classifying", 0.50),
    ("assembling", 0.53),
    ("placing and sampling", 0.55),
    ("solving", 0.65),
    ("writing", 0.90),
)


def main(words=None):
    """The exit code: that of cmfsim."""
    if "--xml" in (sys.argv[1:] if words is None else words):
        print(Path(__file__).with_suffix(".xml").read_text(encoding="utf-8"))
        return 0
    parser = argparse.ArgumentParser(prog=NAME)
    parser.add_argument("case", type=Path)
    parser.add_argument("face", type=Path)
    parser.add_argument("--model", default="M+S", choices=("H", "M", "H+S", "M+S"))
    parser.add_argument("--edge-length", type=float, default=0.0)
    options, _ = parser.parse_known_args(words)
    with tempfile.TemporaryDirectory() as out:
        command = [sys.executable, "-m", "cmfsim", "predict", str(options.case), "-o", out]
        command += ["--model", options.model, "--slicer", "--no-report", "--json"]
        if options.edge_length > 0.0:
            command += ["--edge-length", repr(options.edge_length)]
        return _predict(command, Path(out) / "prediction.mrb", options.face)


def _predict(command, bundle, face):
    print(f"<filter-start>\n<filter-name>{NAME}</filter-name>\n</filter-start>", flush=True)
    with tempfile.TemporaryFile() as answer:
        # Whatever the locale of Slicer is: names of patients and units are no ASCII.
        process = subprocess.Popen(
            command,
            stdout=answer,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            errors="replace",
            env={**os.environ, "PYTHONUTF8": "1"},
        )
        for line in process.stderr:
            text = line.strip().removeprefix("cmfsim: ")
            share = next((part for start, part in STAGES if text.startswith(start)), None)
            if share is not None:
                print(f"<filter-progress>{share}</filter-progress>", flush=True)
            print(f"<filter-comment>{_escaped(text)}</filter-comment>", flush=True)
        code = process.wait()
        if code:
            answer.seek(0)
            print(_error(answer.read().decode("utf-8", "replace")), file=sys.stderr)
            return code
    with zipfile.ZipFile(bundle) as archive:
        name = next(name for name in archive.namelist() if name.endswith(FACE))
        face.write_bytes(archive.read(name))
    print(f"<filter-end>\n<filter-name>{NAME}</filter-name>\n</filter-end>", flush=True)
    return 0


def _error(text):
    try:
        return json.loads(text.strip().splitlines()[-1])["error"]["text"]
    except (IndexError, KeyError, ValueError):
        return text.strip() or "cmfsim failed"


def _escaped(text):
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


if __name__ == "__main__":
    sys.exit(main())
