"""A ring of simulated agents on this machine: separate processes that stream over real loopback UDP."""

import ctypes
import json
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

from rig_protocol.errors import RigError
from rig_protocol.events import Address
from rig_protocol.key_file import write_key
from rig_protocol.poses import Pose
from rig_protocol.rig_folder import read_true_poses
from rig_protocol.rig_key import RigKey
from rig_server.config import RigSettings, RingSettings

_libc = ctypes.CDLL(None, use_errno=True)  # loaded here: nothing may be loaded between fork and exec
_PR_SET_PDEATHSIG = 1

_NICENESS = 10  # real agents run on other machines: these must not starve the server's receive path
_STOP_TIMEOUT_S = 5.0
_LOG_LINES = 15
_FULL_STEP_DEG = 30.0

# Twelve simulated Kinects and the server share two cores at this rate.
SIMULATED_FPS = 5.0


def simulated_settings(settings: RigSettings, cameras: int) -> RigSettings:
    """`settings` for a simulated ring on this machine: its cameras, its drawing, a free loopback port."""
    changes = {
        "listen": "127.0.0.1:0",
        "cameras": (),
        "expected_cameras": cameras,
        "ring": RingSettings(yaw_step_deg=min(_FULL_STEP_DEG, 360.0 / cameras)),
    }
    return RigSettings.model_validate(dict(settings) | changes)


class Simulation:
    """`cameras` agents that stream to `server`, from `start` to `close`.

    Should this process die in any way, the kernel ends the agents. They also die with the thread that
    started them, so start a simulation on a thread that outlives it.
    """

    def __init__(self, cameras: int, seed: int, fps: float, server: Address, rig_key: RigKey) -> None:
        self._cameras = cameras
        self._seed = seed
        self._fps = fps
        self._server = server
        self._rig_key = rig_key
        self._folder = tempfile.TemporaryDirectory(prefix="rig-simulation-")
        self._agents: dict[int, subprocess.Popen[bytes]] = {}

    def start(self) -> None:
        """Start the agents; RigError when the system refuses."""
        write_key(self._key_file, self._rig_key)
        for camera_id in range(self._cameras):
            self._agents[camera_id] = self._start_agent(camera_id)

    def check(self) -> None:
        """RigError with the end of its log when an agent has died."""
        for camera_id, agent in self._agents.items():
            if (status := agent.poll()) is not None:
                raise RigError(
                    f"simulated agent {camera_id} ended with status {status}; the end of its log:\n"
                    + self._log_tail(camera_id)
                )

    def true_poses(self) -> dict[int, Pose]:
        """True T_rig_camera by camera id, which the first agent wrote when it started."""
        return read_true_poses(self._truth_file)

    def close(self) -> None:
        """End all agents and remove their files; harmless when already closed."""
        for agent in self._agents.values():
            agent.terminate()
        for agent in self._agents.values():
            try:
                agent.wait(_STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                agent.kill()
                agent.wait()
        self._agents.clear()
        self._folder.cleanup()

    def _start_agent(self, camera_id: int) -> subprocess.Popen[bytes]:
        host, port = self._server
        options = {
            "--config": self._config_file(),
            "--source": "synthetic",
            "--camera": camera_id,
            "--cameras": self._cameras,
            "--seed": self._seed,
            "--fps": self._fps,
            "--server": f"{host}:{port}",
            "--key-file": self._key_file,
        }
        if camera_id == 0:
            options["--truth-out"] = self._truth_file
        words = [str(word) for option in options.items() for word in option]
        with self._log_file(camera_id).open("wb") as log:
            return subprocess.Popen(  # noqa: S603  # our own program, arguments are ours
                [sys.executable, "-m", "rig_agent.cli", *words],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=_environment(),
                start_new_session=True,  # Ctrl-C is for this program; it ends the agents in order
                preexec_fn=_become_agent,  # only system calls happen in it
            )

    def _config_file(self) -> Path:
        """What no option says; with it, the settings of a real agent on this machine are not read."""
        path = Path(self._folder.name) / "agent.toml"
        path.write_text(f"[synthetic]\nprojector_folder = {json.dumps(self._folder.name)}\n")
        return path

    @property
    def _key_file(self) -> Path:
        return Path(self._folder.name) / "rig.key"

    @property
    def _truth_file(self) -> Path:
        return Path(self._folder.name) / "truth.json"

    def _log_file(self, camera_id: int) -> Path:
        return Path(self._folder.name) / f"agent{camera_id:02d}.log"

    def _log_tail(self, camera_id: int) -> str:
        text = self._log_file(camera_id).read_text(errors="replace")
        return "\n".join(text.splitlines()[-_LOG_LINES:]) or "(empty)"


def _become_agent() -> None:
    """Between fork and exec: end when the parent ends, and leave the processor to the server."""
    _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    os.nice(_NICENESS)


def _environment() -> dict[str, str]:
    """Ours without a real agent's settings; the processes share the cores, so one thread for each."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("RIG_AGENT_")}
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), "1")
    return kept | threads
