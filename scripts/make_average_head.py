"""Makes python/cmfsim/phantom/average_head.npz, the head that proposed landmarks are compared with.

Run it after a change of the shapes in cmfsim.phantom: python scripts/make_average_head.py
"""

from pathlib import Path

from cmfsim.phantom import average_head


def main() -> None:
    """Writes the file and prints its size."""
    path = Path(average_head.__file__).with_name(average_head.FILE)
    average_head.write_average_head(path)
    print(f"{path.name}: {path.stat().st_size / 1024:.0f} kB")


if __name__ == "__main__":
    main()
