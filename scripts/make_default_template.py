"""Writes the built-in template from the phantom head: make_default_template.py [FILE].

Run it after a change of the phantom's muscles, skull or landmarks; a test detects this. It takes
about a minute and needs the extra `imaging`.
"""

import sys
from pathlib import Path

from cmfsim.muscles.template import phantom_template, template_path


def main(path: Path) -> int:
    """Makes the template, writes it, and says how large it is."""
    template = phantom_template(name="default", progress=print)
    template.save(path)
    print(f"wrote {path}: {len(template.muscles)} muscles, {path.stat().st_size} bytes")
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]) if len(sys.argv) > 1 else template_path("default")))
