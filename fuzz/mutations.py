"""Damage to files, reproducible from a seed: bytes, lines, numbers and words."""

import gzip
import io
import random
import re
import struct
import zipfile
from collections.abc import Callable, Sequence

NUMBER = re.compile(rb"-?\b[0-9]+(?:\.[0-9]*)?(?:[eE][-+]?[0-9]+)?\b")
WORD = re.compile(rb"[A-Za-z_]{2,24}")
# Numbers at the ends of what types hold, and what is none.
NUMBERS = (
    *(b"-1", b"0", b"1", b"2", b"-2", b"3", b"255", b"256", b"65536", b"2147483647"),
    *(
        b"2147483648",
        b"-2147483648",
        b"4294967295",
        b"9223372036854775807",
        b"18446744073709551616",
    ),
    *(b"1e309", b"-1e309", b"1e-320", b"1e38", b"1e39", b"nan", b"NaN", b"inf", b"-Infinity"),
    *(b"0x10", b"1_0", b"1,5", b"", b"9" * 400, b"9" * 5000, b"0.1", b"1e3", b"\xd9\xa1"),
)
VALUES = (0, 1, -1, 2, 127, 128, 255, 256, 2**15, 2**16 - 1, 2**31 - 1, -(2**31), 2**32 - 1, 2**40)
REALS = (0.0, -1.0, 1e30, -1e300, float("nan"), float("inf"), 5e-324)
FORMATS = ("<h", ">h", "<i", ">i", "<q", ">q", "<I", ">I", "<Q", ">Q", "B")
REAL_FORMATS = ("<f", ">f", "<d", ">d")
LONGEST = 2**16

Change = Callable[[bytes, random.Random], bytes]


def mutated(data: bytes, dice: random.Random) -> bytes:
    """The bytes with one to three changes."""
    changes: Sequence[Change] = BYTE_CHANGES + (TEXT_CHANGES * 2 if _is_text(data) else ())
    for _ in range(dice.choice((1, 1, 1, 1, 2, 3))):
        data = dice.choice(changes)(data, dice)
    return data


def mutated_inside(data: bytes, dice: random.Random) -> bytes:
    """A packed file whose content is changed and packed again, so that its checksums are right."""
    if data[:2] == b"\x1f\x8b":
        return gzip.compress(mutated(gzip.decompress(data), dice), 1, mtime=0)
    if data[:2] == b"PK":
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [(name, archive.read(name)) for name in archive.namelist()]
        at = dice.randrange(len(members))
        name, content = members[at]
        kind = dice.random()
        if kind < 0.8:
            # The text of an array of characters takes four bytes each: change it as text.
            members[at] = (name, _changed_array(content, dice))
        elif kind < 0.9:
            members.pop(at)
        else:
            members[at] = (mutated(name.encode(), dice).decode("latin-1")[:99] or "x", content)
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in members:
                archive.writestr(zipfile.ZipInfo(name), content)
        return out.getvalue()
    return mutated(data, dice)


def _changed_array(content: bytes, dice: random.Random) -> bytes:
    """An array of numpy's format with a change in its text, its header or its numbers."""
    end = content.find(b"\n") + 1
    head, body = content[:end], content[end:]
    if b"'<U" in head and dice.random() < 0.9:
        text = mutated(body.decode("utf-32-le").encode(), dice).decode("utf-8", "replace")
        head = re.sub(rb"<U[0-9]+", b"<U%d" % max(1, len(text)), head)[: end - 1].ljust(end - 1)
        return head + b"\n" + text.encode("utf-32-le")
    if dice.random() < 0.4:
        changed = mutated(head, dice)
        # Its stated length follows, so that the change is read.
        return changed[:8] + struct.pack("<H", max(0, len(changed) - 10)) + changed[10:] + body
    return head + mutated(body, dice) if dice.random() < 0.9 else mutated(content, dice)


def _is_text(data: bytes) -> bool:
    head = data[:4096]
    return bool(head) and sum(c < 127 and (c > 31 or c in b"\t\n\r") for c in head) > 0.7 * len(
        head
    )


def _span(data: bytes, dice: random.Random) -> tuple[int, int]:
    start = dice.randrange(len(data) + 1)
    return start, min(len(data), start + dice.choice((1, 1, 2, 4, 8, 16, 64, 256)))


def _flip(data: bytes, dice: random.Random) -> bytes:
    if not data:
        return b"\x01"
    at = dice.randrange(len(data))
    return data[:at] + bytes([data[at] ^ 1 << dice.randrange(8)]) + data[at + 1 :]


def _set(data: bytes, dice: random.Random) -> bytes:
    start, _ = _span(data, dice)
    new = dice.choice((b"\0", b"\xff", b"\x80", b"\n", b" ", b'"', b"<", b"]", b"-", b"9"))
    return data[:start] + new + data[start + 1 :]


def _cut(data: bytes, dice: random.Random) -> bytes:
    return data[: dice.randrange(len(data) + 1)]


def _delete(data: bytes, dice: random.Random) -> bytes:
    start, end = _span(data, dice)
    return data[:start] + data[end:]


def _insert(data: bytes, dice: random.Random) -> bytes:
    start, _ = _span(data, dice)
    return data[:start] + dice.randbytes(dice.choice((1, 2, 4, 8, 100))) + data[start:]


def _double(data: bytes, dice: random.Random) -> bytes:
    start, end = _span(data, dice)
    return data[:end] + data[start:end] + data[end:]


def _swap(data: bytes, dice: random.Random) -> bytes:
    a, b = sorted((_span(data, dice), _span(data, dice)))
    if a[1] > b[0]:
        return data[::-1] if len(data) < 64 else data
    return data[: a[0]] + data[b[0] : b[1]] + data[a[1] : b[0]] + data[a[0] : a[1]] + data[b[1] :]


def _number(data: bytes, dice: random.Random) -> bytes:
    if dice.random() < 0.5:
        kind, value = dice.choice(REAL_FORMATS), dice.choice(REALS)
        if kind[1] == "f" and abs(value) > 1e38:
            value = float("inf")
        new = struct.pack(kind, value)
    else:
        kind = dice.choice(FORMATS)
        size = 8 * struct.calcsize(kind)
        value = dice.choice(VALUES) % 2**size
        signed = kind[-1].islower()
        new = struct.pack(kind, value - 2**size if signed and value >= 2 ** (size - 1) else value)
    start = dice.randrange(len(data) + 1)
    start -= start % 4 if dice.random() < 0.5 else 0
    return data[:start] + new + data[start + len(new) :]


def _zeros(data: bytes, dice: random.Random) -> bytes:
    start, end = _span(data, dice)
    return data[:start] + bytes(end - start) + data[end:]


def _lengthen(data: bytes, dice: random.Random) -> bytes:
    more = dice.choice((b"\0", b"\n", b"\xff" * 7, data[-50:], dice.randbytes(50)))
    return data + more


def _replace_match(
    pattern: re.Pattern[bytes], data: bytes, dice: random.Random, new: bytes
) -> bytes:
    found = [match.span() for match in pattern.finditer(data[:LONGEST])]
    if not found:
        return data
    start, end = dice.choice(found)
    return data[:start] + new + data[end:]


def _text_number(data: bytes, dice: random.Random) -> bytes:
    return _replace_match(NUMBER, data, dice, dice.choice(NUMBERS))


def _text_digit(data: bytes, dice: random.Random) -> bytes:
    return _replace_match(re.compile(rb"[0-9]"), data, dice, b"%d" % dice.randrange(10))


def _word(data: bytes, dice: random.Random) -> bytes:
    words = WORD.findall(data[:LONGEST])
    return _replace_match(WORD, data, dice, dice.choice(words)) if words else data


def _lines(data: bytes, dice: random.Random) -> bytes:
    lines = data.split(b"\n")
    at, other = dice.randrange(len(lines)), dice.randrange(len(lines))
    kind = dice.randrange(4)
    if kind == 0:
        del lines[at]
    elif kind == 1:
        lines.insert(at, lines[at])
    elif kind == 2:
        lines[at], lines[other] = lines[other], lines[at]
    else:
        lines[at] = lines[other]
    return b"\n".join(lines)


def _brackets(data: bytes, dice: random.Random) -> bytes:
    start, _ = _span(data, dice)
    new = dice.choice((b"[", b"]", b"{", b"}", b'"', b"'", b"=", b":", b",", b"#", b"<!DOCTYPE a>"))
    return data[:start] + new * dice.choice((1, 1, 1, 3, 5000)) + data[start:]


BYTE_CHANGES: tuple[Change, ...] = (
    *(_flip, _set, _cut, _delete, _insert, _double, _swap, _number, _number, _zeros, _lengthen),
)
TEXT_CHANGES: tuple[Change, ...] = (
    _text_number,
    _text_number,
    _text_digit,
    _word,
    _lines,
    _brackets,
)
