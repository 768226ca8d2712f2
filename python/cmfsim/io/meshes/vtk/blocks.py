"""Packed blocks of VTK's files, unpacked up to the size that they state and no further."""

import lzma
import zlib
from collections.abc import Callable, Mapping
from types import MappingProxyType

from cmfsim.errors import CaseInputError


def _zlib(block: bytes, size: int) -> bytes:
    worker = zlib.decompressobj()
    try:
        out = worker.decompress(block, size + 1)
    except zlib.error as error:
        raise CaseInputError(f"a packed block is damaged ({error})") from error
    if not worker.eof:
        raise CaseInputError("a packed block is cut short, or larger than stated")
    return out


def _lzma(block: bytes, size: int) -> bytes:
    worker = lzma.LZMADecompressor(memlimit=2**28)
    try:
        out = worker.decompress(block, size + 1)
    except (lzma.LZMAError, EOFError) as error:
        raise CaseInputError(f"a packed block is damaged ({error})") from error
    if not worker.eof:
        raise CaseInputError("a packed block is cut short, or larger than stated")
    return out


def _lz4(block: bytes, size: int) -> bytes:
    """An LZ4 block (lz4.github.io/lz4, block format): literals and copies of what came before."""
    out = bytearray()
    at = 0
    try:
        while at < len(block):
            token = block[at]
            length, at = _lz4_length(block, at + 1, token >> 4)
            if at + length > len(block) or len(out) + length > size:
                raise CaseInputError("a packed block is damaged (literals beyond its end)")
            out += block[at : at + length]
            at += length
            if at == len(block):
                break
            back = block[at] | block[at + 1] << 8
            length, at = _lz4_length(block, at + 2, token & 15)
            length += 4
            if not 0 < back <= len(out) or len(out) + length > size:
                raise CaseInputError("a packed block is damaged (a copy from before its start)")
            piece = bytes(out[-back:])
            out += (piece * (length // back + 1))[:length]
    except IndexError:
        raise CaseInputError("a packed block is cut short") from None
    return bytes(out)


def _lz4_length(block: bytes, at: int, length: int) -> tuple[int, int]:
    if length == 15:
        while True:
            more = block[at]
            at += 1
            length += more
            if more != 255:
                break
    return length, at


# By the name that VTK gives the program that packed them; each takes a block and its unpacked size.
UNPACKERS: Mapping[str, Callable[[bytes, int], bytes]] = MappingProxyType(
    {"vtkZLibDataCompressor": _zlib, "vtkLZ4DataCompressor": _lz4, "vtkLZMADataCompressor": _lzma}
)
