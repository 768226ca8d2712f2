"""The folder of real heads."""

import os
from pathlib import Path


def data_folder() -> Path:
    """The folder named by CMFSIM_DATA, else the one beside the project."""
    beside = Path(__file__).parents[3] / "shared" / "data"
    return Path(os.environ.get("CMFSIM_DATA", beside))
