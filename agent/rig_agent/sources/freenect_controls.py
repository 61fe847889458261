"""What an operator may wish of a Kinect, in the operator's words: docs/control.md."""

from dataclasses import dataclass, replace
from typing import Any, Literal, cast, get_args

from rig_agent.sources.base import ControlRefused, ControlValue
from rig_agent.sources.freenect_device import Switches
from rig_agent.sources.freenect_formats import COLOR, DEPTH, ColorName, DepthName

RestartStep = Literal["stream", "device", "usb"]
NAMES = (
    "led",
    "tilt_deg",
    "color",
    "depth",
    "auto_exposure",
    "auto_white_balance",
    "mirror",
    "near_mode",
    "restart",
)
_ON_OFF: dict[ControlValue, bool] = {
    True: True,
    False: False,
    "true": True,
    "false": False,
    "on": True,
    "off": False,
}


@dataclass(frozen=True, slots=True)
class Wishes:
    """How the images should be; kept when the Kinect is opened anew."""

    color: ColorName
    depth: bool
    depth_format: DepthName
    auto_exposure: bool
    auto_white_balance: bool
    mirror: bool
    near_mode: bool

    def told(self, name: str, value: ControlValue, model: str) -> "Wishes":
        """These with one control changed; ControlRefused for one that a Kinect of this model has not."""
        if name == "color":
            return replace(self, color=one_of(ColorName, name, value))
        if name not in ("depth", "auto_exposure", "auto_white_balance", "mirror", "near_mode"):
            raise ControlRefused(f"a Kinect has no control {name}: it has {', '.join(NAMES)}")
        if name == "near_mode" and model != "K4W":
            raise ControlRefused(f"only a Kinect for Windows (K4W) has a near mode, not model {model}")
        if name.startswith("auto_") and self.color == "ir":
            raise ControlRefused(f"{name} is the colour camera's, and infrared is on: set color to bayer")
        changed: dict[str, Any] = {name: on_or_off(name, value)}
        return replace(self, **changed)

    def switches(self, model: str) -> Switches:
        """The same for the device: a model is not told of what it has not."""
        is_color = self.color != "ir"
        return Switches(
            video=COLOR[self.color],
            depth=DEPTH[self.depth_format] if self.depth else None,
            auto_exposure=self.auto_exposure if is_color else None,
            auto_white_balance=self.auto_white_balance if is_color else None,
            mirror=self.mirror,
            near_mode=self.near_mode if model == "K4W" else None,
        )


def one_of(kind: Any, name: str, value: ControlValue) -> Any:
    """The value, one of a Literal's; ControlRefused names them."""
    known = get_args(kind)
    if value not in known:
        raise ControlRefused(f"{name} is one of {', '.join(known)}, not {value}")
    return value


def on_or_off(name: str, value: ControlValue) -> bool:
    """True or false, as a truth value or a word; ControlRefused for anything else."""
    if value not in _ON_OFF:
        raise ControlRefused(f"{name} is true or false, not {value}")
    return _ON_OFF[value]


def degrees(name: str, value: ControlValue) -> float:
    """A number; ControlRefused for anything else."""
    try:
        return float(cast(Any, None if isinstance(value, bool) else value))
    except (TypeError, ValueError) as error:
        raise ControlRefused(f"{name} is a number of degrees, not {value}") from error
