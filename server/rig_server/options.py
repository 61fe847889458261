"""The options of `rig-server` that run it, as typer takes them."""

from pathlib import Path
from typing import Annotated

import typer

_SETTINGS = "Settings; else ./rig.toml, else /etc/kinect-rig/rig.toml, if there."

ConfigOption = Annotated[
    Path | None,
    typer.Option("--config", metavar="FILE", help=_SETTINGS),
]
ListenOption = Annotated[
    str | None, typer.Option(metavar="HOST:PORT", help="Receive here; else 0.0.0.0:4012.")
]
MetricsOption = Annotated[
    str | None,
    typer.Option(metavar="[HOST:]PORT", help="Serve metrics to Prometheus; to this machine unless HOST."),
]
ConsoleOption = Annotated[
    str | None,
    typer.Option(metavar="[HOST:]PORT", help="Serve the console to browsers; to this machine unless HOST."),
]
CalibrateOption = Annotated[
    bool, typer.Option("--calibrate", help="Calibrate the ring on the first complete sets, then end.")
]
SimulateOption = Annotated[
    int | None, typer.Option(metavar="N", min=1, max=64, help="Start N simulated agents on this machine.")
]
SeedOption = Annotated[
    int | None, typer.Option(metavar="S", min=0, help="Seed of the simulated room and units.")
]
FramesOption = Annotated[
    int | None, typer.Option(metavar="K", min=1, max=100, help="Panoramic frames to use; else 5.")
]
MethodOption = Annotated[
    str | None, typer.Option(metavar="joint|paper", help="How to calibrate; else joint.")
]
TargetMmOption = Annotated[
    float | None,
    typer.Option(metavar="X", help="End once neighbours are expected to be known to X mm (RMS)."),
]
TargetDegOption = Annotated[
    float | None, typer.Option(metavar="X", help="The same for their rotation, in degrees.")
]
CoachOption = Annotated[
    bool,
    typer.Option("--coach", help="Go on with fresh sets until every overlap holds: hang patterns meanwhile."),
]
ProjectorGroupsOption = Annotated[
    int | None,
    typer.Option(
        metavar="N", min=1, max=3, help="Capture in 2 or 3 turns, no neighbour's projector on; else 1."
    ),
]
RecalibrateOption = Annotated[
    str | None, typer.Option(metavar="CAMERA", help="Find only this one (name or id) anew, keep all others.")
]
CalibrationOption = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="What --recalibrate starts from; else DIR/calibration.json."),
]
OutOption = Annotated[
    Path | None, typer.Option(metavar="DIR", help="Folder for the results; else ./calibration.")
]
RecordOption = Annotated[
    Path | None, typer.Option(metavar="FILE.mcap", help="Record what comes, as it comes (docs/recording.md).")
]
ReplayOption = Annotated[
    Path | None, typer.Option(metavar="FILE.mcap", help="Take the frames of a recording, not of agents.")
]
ReplaySpeedOption = Annotated[
    str | None, typer.Option(metavar="live|max|X", help="As fast as recorded, as possible, X times as fast.")
]
LoopOption = Annotated[bool, typer.Option("--loop", help="Begin the recording again at its end.")]
SeekOption = Annotated[
    float | None, typer.Option(metavar="S", min=0, help="Leave out the recording's first S seconds.")
]
WatchOption = Annotated[
    Path | None,
    typer.Option(metavar="CALIBRATION", help="Say when a camera moves from its place in this file."),
]
InsecureOption = Annotated[
    bool, typer.Option("--insecure", help="Take frames of anybody: only on an isolated bench.")
]
