"""Widgets of what is mended around an estimate."""

from __future__ import annotations

from typing import Any, Final

from comfy_api.latest import io

from ..dl_core.mending import Mending
from ..dl_core.white_balance import WHITE_BALANCES

__all__ = ["mending_inputs", "mending_of", "tilt_inputs"]

UNKNOWN: Final = 0.0
"""Widget value of a field of view that is not known."""


def tilt_inputs(pitch: str, roll: str) -> list[io.Input]:
    """How the camera was held; both optional."""
    return [
        io.Float.Input("pitch", default=0.0, min=-90.0, max=90.0, step=0.1, optional=True, tooltip=pitch),
        io.Float.Input("roll", default=0.0, min=-180.0, max=180.0, step=0.1, optional=True, tooltip=roll),
    ]


def mending_inputs() -> list[io.Input]:
    """Widgets for `Mending`, all optional and off by default, so that saved workflows load."""
    return [
        io.Boolean.Input(
            "front_fill",
            default=False,
            optional=True,
            tooltip="Fill the directions that the photograph shows with the photograph, as Front Fill does.",
        ),
        io.Float.Input(
            "fov",
            default=UNKNOWN,
            min=UNKNOWN,
            max=170.0,
            step=0.1,
            optional=True,
            tooltip="With front_fill, degrees that the photograph spans along its longer side, from 5; 0 is not known.",
        ),
        *tilt_inputs(
            "Degrees that the camera looked up; the map's horizon is levelled by it.",
            "Degrees that the camera was turned clockwise; the map's horizon is levelled by it.",
        ),
        io.Combo.Input(
            "white_balance",
            options=list(WHITE_BALANCES),
            default="none",
            optional=True,
            tooltip="How the photograph's cast is found, which is taken out before painting and given back to the "
            "light; none leaves it in.",
        ),
    ]


def mending_of(options: dict[str, Any]) -> Mending:
    """What the widgets ask for, checked; widgets that an older workflow has not are off.

    Raises:
        OptionError: a value out of range, or front fill without a field of view.
    """
    fov = options.pop("fov", UNKNOWN)
    return Mending(
        front_fill=options.pop("front_fill", False),
        fov=None if fov == UNKNOWN else fov,
        pitch=options.pop("pitch", 0.0),
        roll=options.pop("roll", 0.0),
        white_balance=options.pop("white_balance", "none"),
    ).check()
