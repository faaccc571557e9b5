"""What is chosen by name; without torch, so that a wrong name is refused at once."""

from __future__ import annotations

from collections.abc import Sequence

from rbfevo.errors import UserError

MANIPULATIONS = ("indirect", "direct")
POLYNOMIALS = ("linear",)  # of RBFs, or null
DEVICES = ("auto", "cpu", "cuda")
EVALUATORS = ("auto", "fused", "eager")
FIT_MANIPULATIONS = (*MANIPULATIONS, "orthogonalized")
WITHOUT_EFFECT = ("checkpoint", "device", "figures", "quiet")  # on which no result depends; may change on resume
FIT_STRATEGIES = ("isotropic", "cmaes")


def refuse_others(setting: str, value: object, choices: Sequence[str]) -> None:
    """Raise UserError unless a setting's value is one of the choices."""
    if value not in choices:
        raise UserError(f"{setting}={value}: there is no such {setting}; choose one of {', '.join(choices)}")
