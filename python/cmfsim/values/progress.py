"""Progress callbacks: what is called with the name of each stage as it begins."""

from collections.abc import Callable

Progress = Callable[[str], None]


def no_progress(stage: str) -> None:
    """Reports nothing: the default that stages call if no progress is requested."""
    del stage
