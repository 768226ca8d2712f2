"""Collects the texts that people read, as messages of GNU gettext: extract_texts.py [FILE.pot].

Of the package's Python every text of several words, and in the rooms that show texts single words
as well; of its tables some columns; of its pages' scripts those that are tagged _`…`; of their
templates what stands between tags. Values become {0}, {1} …, and a comment states what they are.
"""

import ast
import csv
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "python/cmfsim"
# Rooms in which single words are headings, labels and names of regions.
SHOWN = ("report", "planning", "desk", "evaluation", "pictures", "cli", "values")
PROSE = re.compile(r"[^\W\d_]{3,}[,.:;)]? +[(“\"]?[\w{]|\}[,.:;)]* +[a-z]{2,}")
WORD = re.compile(r"(?!.*\w\.[a-z])(?=.*[^\W\d_]{2})[^\W\d_][^_=/{}<>\\]*")
# Columns of tables that people read.
TABLE_TEXTS = ("label", "norm", "source", "about")
# Words in names of files, which nobody is shown.
WORDS_OF_FILES = frozenset({"drafting/part_words.json"})
# What the finding table fills in.
BLANK = re.compile(r"\{\w*(?:!r)?(?::[^}]*)?\}")
SCRIPT_TEXT = re.compile(r"(?<![\w$])_`")
FILLED = re.compile(r"<(style|title)>.*?</\1>|\{%.*?%\}|\{\{.*?\}\}", re.DOTALL)
TAGGED = re.compile(r"(?:>|aria-label=\")([^<>{}@\"]*[a-z]{2,}[^<>{}@\"]*)(?=[<\"])")

# A text, the expressions of its values, and where it stands.
Found = tuple[str, list[str], str]


def main(target: Path | None) -> int:
    """Writes the messages, to standard output without a file."""
    messages: dict[str, tuple[list[str], list[str]]] = {}
    for text, values, place in found_texts():
        places = messages.setdefault(text, (values, []))[1]
        places.append(place)
    blocks = [
        'msgid ""\nmsgstr ""\n"Content-Type: text/plain; charset=UTF-8\\n"\n"Language: \\n"\n'
    ]
    for text, (values, places) in messages.items():
        about = [f"#. {{{i}}}: {' '.join(value.split())}" for i, value in enumerate(values)]
        lines = [*about, f"#: {' '.join(dict.fromkeys(places))}", f"msgid {_quoted(text)}"]
        blocks.append("\n".join([*lines, 'msgstr ""\n']))
    whole = "\n".join(blocks)
    if target is None:
        sys.stdout.write(whole)
    else:
        target.write_text(whole, encoding="utf-8")
        print(f"{target}: {len(messages)} messages")
    return 0


def found_texts() -> Iterator[Found]:
    """Every text of the package, with its values and its place."""
    for path in sorted(PACKAGE.rglob("*.*")):
        name = path.relative_to(PACKAGE).as_posix()
        is_table = path.suffix == ".json" and name not in WORDS_OF_FILES
        if path.suffix not in {".py", ".js", ".html", ".csv"} and not is_table:
            continue
        source = path.read_text(encoding="utf-8")
        if path.suffix == ".py" or is_table:
            # JSON of texts and numbers reads as Python.
            yield from _of_python(source, name)
        elif path.suffix == ".csv":
            rows = csv.DictReader(source.splitlines())
            cells = (row[column] for row in rows for column in TABLE_TEXTS if row.get(column))
            yield from ((c, [], name) for c in cells if PROSE.search(c) or WORD.fullmatch(c))
        elif path.suffix == ".js":
            for match in SCRIPT_TEXT.finditer(source):
                text, values, _ = _template_literal(source, match.end())
                yield text, values, f"{name}:{source.count(chr(10), 0, match.start()) + 1}"
        else:
            plain = FILLED.sub("", source)
            yield from ((m[1].strip(), [], name) for m in TAGGED.finditer(plain))


def _of_python(source: str, name: str) -> Iterator[Found]:
    tree = ast.parse(source)
    parents = {child: node for node in ast.walk(tree) for child in ast.iter_child_nodes(node)}
    is_shown = name.startswith(SHOWN) and name != "cli/commands.json"
    for node in ast.walk(tree):
        above = parents.get(node)
        if isinstance(above, ast.Expr | ast.JoinedStr | ast.FormattedValue) and not isinstance(
            node, ast.JoinedStr
        ):
            continue
        # A sum of texts is one message, found at the outermost sum.
        if isinstance(above, ast.BinOp) and _parts(above):
            continue
        parts = _parts(node)
        values = [part for part in parts if isinstance(part, ast.expr)]
        count = iter(range(len(values)))
        text = "".join(p if isinstance(p, str) else f"{{{next(count)}}}" for p in parts)
        shown = [ast.unparse(value) for value in values]
        if not values and (blanks := BLANK.findall(text)):
            count = iter(range(len(blanks)))
            text, shown = BLANK.sub(lambda _: f"{{{next(count)}}}", text), blanks  # noqa: B023
        for each in [text] if values else text.split("|"):
            is_text = PROSE.search(each) or (is_shown and not shown and WORD.fullmatch(each))
            if is_text and not _is_key(node, above):
                yield each.strip(), shown, f"{name}:{getattr(node, 'lineno', 0)}"


def _parts(node: ast.AST | None) -> list[str | ast.expr]:
    """The pieces of a text that code writes: literals, and expressions; none of other nodes."""
    if isinstance(node, ast.Constant):
        return [node.value] if isinstance(node.value, str) else []
    if isinstance(node, ast.JoinedStr):
        return [
            piece
            for value in node.values
            for piece in ([value.value] if isinstance(value, ast.FormattedValue) else _parts(value))
        ]
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        left, right = _parts(node.left), _parts(node.right)
        return [*(left or [node.left]), *(right or [node.right])] if left or right else []
    return []


def _is_key(node: ast.AST, above: ast.AST | None) -> bool:
    """Whether a word is an index, a key or compared: it names something."""
    is_word = isinstance(node, ast.Constant) and not PROSE.search(str(node.value))
    return is_word and isinstance(above, ast.Subscript | ast.Compare)


def _template_literal(source: str, start: int) -> tuple[str, list[str], int]:
    """Text, values and end of a template literal of JavaScript from behind its first quote."""
    text, at = "", start
    values: list[str] = []
    while source[at] != "`":
        if source[at] == "\\":
            text, at = text + source[at + 1], at + 2
        elif source.startswith("${", at):
            end = _expression_end(source, at + 2)
            text += f"{{{len(values)}}}"
            values.append(source[at + 2 : end])
            at = end + 1
        else:
            text, at = text + source[at], at + 1
    return text, values, at + 1


def _expression_end(source: str, at: int) -> int:
    """Where the brace closes that opened before `at`."""
    while source[at] != "}":
        if source[at] == "`":
            at = _template_literal(source, at + 1)[2]
        elif source[at] == "{":
            at = _expression_end(source, at + 1) + 1
        else:
            at += 1
    return at


def _quoted(text: str) -> str:
    escapes = {"\\": "\\\\", '"': '\\"', "\n": "\\n"}
    return f'"{"".join(escapes.get(c, c) for c in text)}"'


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]) if len(sys.argv) > 1 else None))
