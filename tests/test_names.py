"""Any legal file name can be given on the command line: Hydra and OmegaConf hand it on as it is."""

from __future__ import annotations

import re
from pathlib import Path

import hydra
import numpy as np
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import example, given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from rbfevo import names
from rbfevo.__main__ import main
from rbfevo.commands import overrides
from rbfevo.errors import UserError
from rbfevo.runs.config import CONF, ROOTS

SIGNS = r"""ab ,='"[](){}#$\:~%&|;!?*<>@`^é网.-_/0"""
ODD = [  # each has been a mistake of this program, of Hydra or of OmegaConf
    "${x}",
    "~name",
    "a \\",
    "a b",
    "a(1), b=c [x]",
    "it's",
    '"x',
    "a#b",
    "${.}",
    "\\${a}",
    "$",
    "${",
    "???",
    "true",
    "1e3",
    "{a:1}",
    "a,b",
    "tür网",
    "\\'",
    "NULL",
]
NAMES = st.text(st.sampled_from(SIGNS), min_size=1, max_size=12).filter(lambda name: name.strip() == name)


def composed(*arguments: str) -> str:
    """The template that words give, after Hydra's parser, its composition and OmegaConf's resolution."""
    with overrides.initialized(CONF):
        config = hydra.compose("config", overrides=["scenario=mesh", *arguments])
    return OmegaConf.to_container(config, resolve=True)["scenario"]["template"]  # type: ignore[index,call-overload]


def with_names(test):
    """The names that were mistakes, besides those that hypothesis draws."""
    for name in ODD:
        test = example(name=name)(test)
    return given(name=NAMES)(test)


@with_names
def test_a_name_that_the_program_writes_comes_back(name: str) -> None:
    word = names.override("scenario.template", name)
    (parsed,) = OverridesParser.create().parse_overrides([word])
    value = OmegaConf.create({"name": parsed.value()})["name"]
    assert str(value).removeprefix("./") == name.removeprefix("./")
    assert names.quoted([word], ROOTS) == [word] or names.given(names.quoted([word], ROOTS), "scenario.template") == (
        names.given([word], "scenario.template")
    )


@with_names
def test_a_name_is_given_as_it_stands(name: str) -> None:
    quoted = re.fullmatch(r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*\"""", name) is not None
    if quoted or name.lower() == "null" or re.search(r"\\\$\{", name):
        return  # rules 1, 2 and 4: there it is not the name as it stands
    (word,) = names.quoted([f"scenario.template={name}"], ROOTS)
    (parsed,) = OverridesParser.create().parse_overrides([word])
    value = str(OmegaConf.create({"name": parsed.value()})["name"])
    assert value == ("./???" if name == "???" else name)


@pytest.mark.parametrize("name", ODD)
def test_odd_names_go_through_the_whole_configuration(name: str) -> None:
    if name in ("NULL", "\\${a}"):
        return
    assert composed(*names.quoted([f"scenario.template={name}"], ROOTS)).removeprefix("./") == name


@pytest.mark.parametrize(
    ("given", "name"),
    [
        ("'a b'", "a b"),
        ('"a, b"', "a, b"),
        (r"'it\'s'", "it's"),
        (r"'a\\'", "a\\"),
        ("'null'", "null"),
        (r"\${seed}", "${seed}"),
        ("part-${seed}.obj", "part-0.obj"),
        ("${oc.env:RBFEVO_A_NAME}/a", "there/a"),
        ("a ${centers} b", "a 25 b"),
        ("${nothing}", "${nothing}"),
        ("${no.resolver:x}", "${no.resolver:x}"),
    ],
)
def test_quotes_and_what_is_filled_in(given: str, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RBFEVO_A_NAME", "there")
    assert composed(*names.quoted([f"scenario.template={given}"], ROOTS)) == name


@pytest.mark.parametrize(
    ("value", "parts"),
    [
        ("a,b", ["a", "b"]),
        ("'a,b',c", ["a,b", "c"]),
        ("a b, c(1)", ["a b", "c(1)"]),
        ('"a, b"', ["a, b"]),
        ("a-${now:%H,%M},b", None),
    ],
)
def test_a_comma_separates_names_in_a_sweep_alone(value: str, parts: list[str] | None) -> None:
    (_, swept), (alone,) = (names.quoted([*more, f"scenario.template={value}"], ROOTS) for more in (["-m"], []))
    (parsed,) = OverridesParser.create().parse_overrides([swept])
    if parts is None:
        assert len(list(parsed.sweep_string_iterator())) == 2
        return
    found = [str(OverridesParser.create().parse_overrides([f"x={part}"])[0].value()) for part in (
        parsed.sweep_string_iterator() if parsed.is_sweep_override() else [swept.partition("=")[2]])]  # fmt: skip
    assert found == parts
    assert not OverridesParser.create().parse_overrides([alone])[0].is_sweep_override()


def test_boxes_and_nothing_stay_what_they_are() -> None:
    arguments = ["scenario.fixed=[0,0,0,1,1,1]", "scenario.scan=null", "seed=1,2"]
    assert names.quoted(arguments, ROOTS) == arguments
    assert names.given(["hydra.run.dir=outputs/${now:%Y}", "hydra.run.dir='a b'"], "hydra.run.dir") == ["a b"]


def test_a_home_is_that_of_a_user_that_there_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/of me")
    assert names.existing_home("~/a") == Path("/home/of me/a")
    assert names.existing_home("~no such user/a") == Path("~no such user/a")


def test_a_directory_that_hydra_cannot_note_is_refused() -> None:
    with pytest.raises(UserError, match="Hydra cannot use a path with this"):
        names.refuse_unheld("a/${.", "hydra.run.dir=a/${.")
    names.refuse_unheld("a/${x}", "hydra.run.dir")


@pytest.mark.parametrize("directory", ["~run", "a ${x} (1), b=c", "it's \\"])
def test_odd_run_directories_hold_a_run_that_can_be_resumed(
    directory: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = ["scenario.resolution=[12,12]", "centers=3", "evaluator=eager", "figures=false", "quiet=true"]
    arguments += ["method=nsga2", "method.population=6", "method.generations=2"]
    assert main([*arguments, f"hydra.run.dir={directory}"]) == 0
    with np.load(tmp_path / directory / "setups.npz") as archive:
        assert archive["centers"].shape[1:] == (3, 2)
    assert main([f"resume={directory}", "method.generations=3"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == [directory]
