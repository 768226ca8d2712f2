"""The index of the benches names every file beside it."""

from pathlib import Path

BENCHES = Path(__file__).parents[3] / "benches"
ROOMS = ("accuracy", "speed", "stability", "scenes")


def test_the_index_names_every_bench():
    """A bench that is not in the index is not found, and one that is gone is not looked for."""
    text = (BENCHES / "README.md").read_text(encoding="utf-8")
    paths = [path for room in ROOMS for path in (BENCHES / room).iterdir()]
    files = {path.name for path in paths if path.suffix in {".py", ".rs", ".toml"}}
    named = {word.strip("`,.;:()") for word in text.split() if word.startswith("`")}
    assert not {name for name in files if f"`{name}`" not in text}
    assert not {name for name in named if name.endswith((".py", ".rs")) and "/" not in name} - files
