"""Nastran's bulk data: the GRID cards are written anew, in large fields, and all other bytes stay."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import NamedTuple

from rbfevo.arrays import Array
from rbfevo.meshes.mesh import FormatError, Mesh, written_as
from rbfevo.meshes.numbered import Numbered

# Elements by their card: how many fields stand before their nodes, and VTK's kind by the number of nodes.
_CARDS: dict[str, tuple[int, dict[int, int]]] = {
    **dict.fromkeys(("CTRIA3", "CTRIAR"), (2, {3: 5})),
    "CTRIA6": (2, {3: 5, 6: 22}),
    **dict.fromkeys(("CQUAD4", "CQUADR", "CSHEAR"), (2, {4: 9})),
    "CQUAD8": (2, {4: 9, 8: 23}),
    "CQUAD": (2, {4: 9, 9: 28}),
    "CTETRA": (2, {4: 10, 10: 24}),
    "CHEXA": (2, {8: 12, 20: 25}),
    "CPENTA": (2, {6: 13, 15: 26}),
    **dict.fromkeys(("CPYRAM", "CPYRA"), (2, {5: 14, 13: 27})),
    **dict.fromkeys(("CBAR", "CBEAM", "CROD", "CTUBE", "CBEND"), (2, {2: 3})),
    **dict.fromkeys(("CONROD", "PLOTEL"), (1, {2: 3})),
}
_ORDERS = {25: [*range(12), 16, 17, 18, 19, 12, 13, 14, 15], 26: [*range(9), 12, 13, 14, 9, 10, 11]}
_AREAS = re.compile(r"C(?:TRI|QUA|TET|HEX|PEN|PYR)")  # what else begins so has an area or a volume
_REAL = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+))(?:[eEdD]?([-+]\d+)|[eEdD](\d+))?")


class _Card(NamedTuple):
    """A card: its name, its fields after it, and where its text begins and ends; `large`: spans of its fields."""

    name: str
    fields: list[str]
    begin: int
    end: int
    large: list[tuple[int, int]] | None


def read_nastran(content: bytes) -> Mesh:
    """The GRID points and elements of bulk data, in free, small and large fields; patches are the properties (PID).

    Raises:
        FormatError: if elements with an area or a volume are of a kind that is not read, with their number, or points
            lie in coordinate systems of their own, or the file includes others.
    """
    numbered, cards = Numbered(), []
    unknown: dict[str, int] = {}
    systems = 0
    for card in _cards(content):
        if card.name == "GRID":
            numbered.node(_whole(card, 0), [_real(card, place) for place in (2, 3, 4)])
            systems += _field(card, 1) not in ("", "0")
            cards.append(card)
        elif card.name in _CARDS:
            first, kinds = _CARDS[card.name]
            nodes = [_field(card, place) for place in range(first, first + max(kinds))]
            # Later fields of a shell are an angle and thicknesses; nodes in the middle of edges may be left out.
            whole = [int(node) if node.isdigit() else 0 for node in nodes]
            count = max((count for count in kinds if all(whole[:count])), default=0)
            if not count:
                raise FormatError(f"{card.name} {_field(card, 0)} has fewer nodes than its kind needs")
            kind = kinds[count]
            corners = [whole[place] for place in _ORDERS[kind]] if kind in _ORDERS else whole[:count]
            patch = f"property {_field(card, 1)}" if first == 2 else ""
            numbered.cell(_whole(card, 0), kind, corners, [patch] if patch else [])
        elif _AREAS.match(card.name):
            unknown[card.name] = unknown.get(card.name, 0) + 1
        elif card.name == "INCLUDE":
            raise FormatError("it includes other files (INCLUDE); write one file with all of the mesh")
        elif card.name == "GRDSET" and _field(card, 1) not in ("", "0"):
            raise FormatError(
                "its points lie in a coordinate system of their own (GRDSET); write them in the basic one"
            )
    if unknown:
        listed = ", ".join(f"{count} {name}" for name, count in unknown.items())
        raise FormatError(f"it has elements that are not read: {listed}")
    if systems:
        raise FormatError(
            f"{systems} of its {len(cards)} GRID points lie in coordinate systems of their own (CP); write them in the "
            "basic one"
        )
    mesh = numbered.mesh()

    def rewritten(moved: Array) -> bytes:
        """The bytes of the file with moved points [n, 3]."""
        pieces, end = [], 0
        for card, point in zip(cards, moved.tolist(), strict=True):
            for begin, stop, text in _replacements(card, point):
                pieces += [content[end:begin], text.encode()]
                end = stop
        return b"".join([*pieces, content[end:]])

    kept = ["GRID points are written in large fields, of 16 characters, which round the coordinates"]
    return Mesh(mesh.points, written_as(rewritten), mesh.cells, patches=mesh.patches, numbers=mesh.numbers, kept=kept)


def _cards(content: bytes) -> Iterator[_Card]:
    """The cards of the bulk data; lines before BEGIN BULK, after ENDDATA and comments are passed over."""
    begins = re.search(rb"^[ \t]*BEGIN[ \t]+BULK\b[^\r\n]*", content, re.IGNORECASE | re.MULTILINE)
    offset = begins.end() if begins else 0
    name, fields, begin, end, large = "", [], 0, 0, None
    for raw in content[offset:].splitlines(keepends=True):
        line = raw.split(b"$", 1)[0].rstrip().decode("latin-1")
        start, offset = offset, offset + len(raw)
        if not line.strip():
            continue
        if "\t" in line and "," not in line:
            line, tabs = line.expandtabs(8), True
        else:
            tabs = False
        head, found, spans = _fields(line, start)
        spans = None if tabs else spans
        if head[:1] in ("+", "*") or not head:
            if not name:
                raise FormatError(f"it has a continuation that continues nothing: {line[:40]!r}")
            each = 8 if large is None else 4
            fields += [""] * (-len(fields) % each) + found
            large = None if large is None or spans is None else large + spans
            end = start + len(raw.rstrip(b"\r\n"))
            continue
        if name:
            yield _Card(name, fields, begin, end, large)
        name, fields, begin, end = head.rstrip("*").upper(), found, start, start + len(raw.rstrip(b"\r\n"))
        large = spans if head.endswith("*") else None
        if name == "ENDDATA":
            return
    if name:
        yield _Card(name, fields, begin, end, large)


def _fields(line: str, start: int) -> tuple[str, list[str], list[tuple[int, int]] | None]:
    """The first field of a line, the others and, of fixed large fields, where these stand."""
    if "," in line:
        first, *found = (field.strip() for field in line.split(","))
        return first, found, None
    head = line[:8].strip()
    if head.upper().startswith("INCLUDE"):
        return "INCLUDE", [], None
    width, count = (16, 4) if head.endswith("*") or head.startswith("*") else (8, 8)
    places = [(8 + width * i, 8 + width * (i + 1)) for i in range(count)]
    found = [line[a:b].strip() for a, b in places if a < len(line)]
    spans = [(start + a, start + min(b, len(line))) for a, b in places if a < len(line)]
    return head, found, spans if width == 16 else None


def _field(card: _Card, place: int) -> str:
    return card.fields[place] if place < len(card.fields) else ""


def _whole(card: _Card, place: int) -> int:
    try:
        return int(_field(card, place))
    except ValueError:
        raise FormatError(f"a card {card.name} has {_field(card, place)[:20]!r} where a number is expected") from None


def _real(card: _Card, place: int) -> float:
    """A real number as Nastran writes it: 1.5-3 is 1.5e-3; an empty field is 0."""
    text = _field(card, place)
    if not text:
        return 0.0
    found = _REAL.fullmatch(text)
    if not found:
        raise FormatError(f"GRID {_field(card, 0)} has {text[:20]!r} where a coordinate is expected")
    exponent = found[2] or found[3]
    return float(found[1] + (f"e{exponent}" if exponent else ""))


def _replacements(card: _Card, point: list[float]) -> list[tuple[int, int, str]]:
    """What to put where in the file, so that a GRID card has other coordinates."""
    texts = [sixteen(number) for number in point]
    if card.large is not None and len(card.large) >= 5 and all(b - a == 16 for a, b in card.large[2:4]):
        return [(*card.large[2 + i], f"{texts[i]:>16}") for i in range(3)]
    fields = [*card.fields[:2], *texts, *card.fields[5:8]]
    fields += [""] * (8 - len(fields))
    first, second = ("".join(f"{field:>16}" for field in part) for part in (fields[:4], fields[4:]))
    return [(card.begin, card.end, f"GRID*   {first}\n*       {second}".rstrip())]


def sixteen(number: float) -> str:
    """A real number in 16 characters, with a point, as near as they allow."""
    texts = [repr(number)]
    for digits in range(15, 5, -1):
        fixed = f"{number:.{digits}f}"
        texts += [fixed, fixed.replace("0.", ".", 1) if abs(number) < 1 else fixed]
        mantissa, exponent = f"{number:.{digits}E}".split("E")
        texts.append(f"{mantissa}E{int(exponent)}")
    fitting = [text for text in texts if len(text) <= 16 and "." in text]
    return min(fitting, key=lambda text: (abs(float(text) - number), len(text)))
