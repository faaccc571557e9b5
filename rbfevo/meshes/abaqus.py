"""Abaqus' input files: the coordinates of nodes are put in place, all other bytes stay."""

from __future__ import annotations

import re

from rbfevo.meshes.mesh import FormatError, Mesh, written_as
from rbfevo.meshes.numbered import Numbered
from rbfevo.meshes.places import Places, lines, numbers

# Types of elements by a pattern that captures their number of nodes, and VTK's kind by that number.
_FLAT = {3: 5, 4: 9, 6: 22, 8: 23, 9: 28}
_SOLID = {4: 10, 5: 14, 6: 13, 8: 12, 10: 24, 13: 27, 15: 26, 20: 25}
_LINE = {2: 3, 3: 21}
_TYPES = (
    (r"(?:A|D|)C3D(\d+)|(?:EC|Q|)3D(\d+)|COH3D(\d)P?|SC(6|8)R?T?|GK3D(\d+)M?", _SOLID),
    (r"STRI(3)|S(3|4|8|9)(?:[A-Z].*)?|DS(\d)|M3D(\d)|SFM3D(\d)|R3D(\d)|F3D(\d)", _FLAT),
    (r"CP[ES](\d)|CPEG(\d+)|CG?AX(\d)|(?:AC|DC|DCC|Q)(?:2D|AX)(\d)|COH(?:2D|AX)(\d)|WARP2D(\d)", _FLAT),
    (r"[TB]\dD(\d)|B\d(1|2|3)(?:[A-Z].*)?|PIPE\d(1|2)|CONN\dD(\d)|RAX(2)|R2D(2)|SAX(1|2)|DC1D(\d)|FRAME\d(\d)", _LINE),
)
_NO_SHAPE = re.compile(r"MASS|ROTARYI|SPRING|DASHPOT|JOINT|ITS|GAP|HEATCAP|DCOUP|CAPACITANCE|POINT")
_GENERATING = ("NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY", "INCLUDE", "SYSTEM")


def read_abaqus(content: bytes) -> Mesh:
    """The nodes and elements of all blocks and parts, in the file's order; patches are the element sets.

    Raises:
        FormatError: if nodes or elements are generated, included or transformed, or elements are of a type that is not
            read, with their number.
    """
    places: Places | None = None
    numbered = Numbered()
    sets: list[tuple[str, str, list[str]]] = []
    unknown: dict[str, int] = {}
    instances: dict[str, int] = {}
    keyword, options, part, element, parts = "", {}, "", [], 0
    count, kind, patch = 0, 0, ""
    dimension = 0
    for offset, line in lines(content):
        text = line.strip().decode("latin-1")
        if text.startswith("**"):
            continue
        if text.startswith("*"):
            if element:
                raise FormatError(f"element {element[0]} has {len(element) - 1} nodes instead of {count}")
            keyword, options = _keyword(text)
            if keyword in _GENERATING:
                raise FormatError(
                    f"it uses *{keyword}, which is not read; write a flat file with all nodes and elements"
                )
            if keyword in ("NODE", "ELEMENT") and "INPUT" in options:
                raise FormatError(f"its *{keyword} block is in another file ({options['INPUT']}); write one file")
            if keyword == "PART":
                part, parts = options.get("NAME", f"part {parts + 1}"), parts + 1
            elif keyword in ("END PART", "ASSEMBLY"):
                part = "" if keyword == "END PART" else "assembly"
            elif keyword == "INSTANCE":
                name = options.get("PART", "")
                instances[name] = instances.get(name, 0) + 1
            elif keyword == "ELEMENT":
                kind, count = _element(options.get("TYPE", ""))
                patch = options.get("ELSET", "")
            elif keyword in ("ELSET",):
                sets.append((part, options.get("ELSET", ""), ["GENERATE"] if "GENERATE" in options else []))
            continue
        if keyword == "NODE":
            fields = [field.strip() for field in line.split(b",")]
            fields = fields[:-1] if not fields[-1] else fields
            if places is None:
                dimension = min(len(fields) - 1, 3)
                if dimension < 2:
                    raise FormatError(f"a node has {dimension} coordinates: {text[:40]!r}")
                places = Places(content, range(1, 1 + dimension), b",")
            if not fields[0].isdigit():
                raise FormatError(f"a node has no number: {text[:40]!r}")
            places.add(offset, line)
            numbered.node(int(fields[0]), numbers(fields[1 : 1 + dimension], "a node", 1).tolist(), part)
        elif keyword == "ELEMENT":
            if not kind:
                name = options.get("TYPE", "").upper()
                unknown[name] = unknown.get(name, 0) + 1
                continue
            try:
                element += [int(field) for field in text.split(",") if field.strip()]
            except ValueError:
                raise FormatError(f"an element has something that is no number: {text[:40]!r}") from None
            if len(element) >= 1 + count:
                if len(element) > 1 + count:
                    raise FormatError(f"element {element[0]} has {len(element) - 1} nodes instead of {count}")
                numbered.cell(element[0], kind, element[1:], [_named(part, patch, parts)] if patch else [], part)
                element = []
        elif keyword == "ELSET":
            sets[-1][2].extend(field.strip() for field in text.split(",") if field.strip())
        elif keyword == "INSTANCE" and text:
            raise FormatError("its instances move parts, which is not read; write a flat file, without parts")
    if element:
        raise FormatError(f"cut off: element {element[0]} has {len(element) - 1} nodes instead of {count}")
    several = {name: times for name, times in instances.items() if times > 1}
    if several:
        raise FormatError(f"the part {next(iter(several))} has several instances; write a flat file, without parts")
    unknown = {name: number for name, number in unknown.items() if not _NO_SHAPE.match(name)}
    if unknown:
        raise FormatError(
            f"it has elements that are not read: {', '.join(f'{n} {name}' for name, n in unknown.items())}"
        )
    if places is None:
        raise FormatError("it holds no points; is it empty or damaged?")
    _add_sets(numbered, sets, parts)
    mesh = numbered.mesh()
    return Mesh(
        places.points(),
        written_as(places.rewritten),
        mesh.cells,
        patches=mesh.patches,
        numbers=mesh.numbers,
        dimension=dimension,
    )


def _keyword(text: str) -> tuple[str, dict[str, str]]:
    """The keyword of a line and its options, both in capitals; values of options stay."""
    first, *others = (part.strip() for part in text[1:].split(","))
    options = {}
    for other in others:
        name, _, value = other.partition("=")
        options[name.strip().upper()] = value.strip().strip('"')
    return " ".join(first.upper().split()), options


def _element(name: str) -> tuple[int, int]:
    """VTK's kind of a type of elements and its number of nodes; (0, 0) if it is not read."""
    upper = name.upper()
    if upper in ("STRI65", "M3D6", "DS6"):
        return 22, 6
    for pattern, kinds in _TYPES:
        found = re.match(rf"(?:{pattern})(?!\d)", upper)
        if found:
            digits = int(next(group for group in found.groups() if group))
            if kinds is _LINE and re.match(r"B\d|PIPE|SAX|FRAME", upper):
                digits = {1: 2, 2: 3, 3: 2}[digits]  # B31 has two nodes, B32 three, B33 two
            return (kinds[digits], digits) if digits in kinds else (0, 0)
    return 0, 0


def _named(part: str, patch: str, parts: int) -> str:
    return f"{part}.{patch}" if part and parts > 1 else patch


def _add_sets(numbered: Numbered, sets: list[tuple[str, str, list[str]]], parts: int) -> None:
    """Sets of elements by numbers, by ranges, or by other sets."""
    for part, name, entries in sets:
        own = _named(part, name, parts)
        if entries[:1] == ["GENERATE"]:
            values = [int(entry) for entry in entries[1:] if entry.lstrip("-").isdigit()]
            for i in range(0, len(values), 3):
                first, last, *step = values[i : i + 3]
                numbered.patch(own, range(first, last + 1, step[0] if step else 1), part)
            continue
        numbered.patch(own, (int(entry) for entry in entries if entry.isdigit()), part)
        for entry in entries:
            if not entry.isdigit():
                numbered.join(own, _named(part, entry, parts))
