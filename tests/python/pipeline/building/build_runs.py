"""Builds that are run in this process, and the pictures that they draw."""

import contextlib
import io

from cmfsim.cli import main

PICTURES = {"anatomy.png", "node_kinds.png"}


def run(*words):
    """The exit code of a command, and what it wrote to its two streams."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main([str(word) for word in words])
    return code, out.getvalue(), err.getvalue()
