"""Agents killed at random, every few seconds for minutes: how soon the sets are whole again after each kill.

Twelve real `rig-agent` processes play small images at 10 frames/s to a real server process. A stand-in for
systemd starts each of them again as the deployed unit says. Which, when and how, is seeded.

Run: python tests/benchmarks/agent_soak.py [MINUTES]    (make soak-agents)
Writes the section `agent_soak` of build/bench.json and of docs/performance.md.
"""

import argparse
import os
import random
import re
import signal
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import mean, median
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from transport_chaos import CAMERAS, FPS, ServerProcess

from support.benchmark_record import REPOSITORY, machine, markdown_table, merge_results, write_section
from support.kill_recovery import (
    ALLOWED_S,
    DeliveredSet,
    Kill,
    camera_since,
    complete_since,
    unexplained,
    whole_since,
)
from support.rig_processes import AgentProcess, free_port, write_small_rig

GAP_S = (2.0, 8.0)  # between kills
SETTLE_S = 15.0  # an agent is left alone for so long after a kill, so that every kill has its own recovery
SIGNALS = {"SIGKILL": signal.SIGKILL, "SIGTERM": signal.SIGTERM}
SEED = 5

_PAGE = """## Agents killed at random

`make soak-agents` on {machine}, at a load of {load_mean:.1f} on average,
{load_max:.1f} at most. Twelve real `rig-agent` processes at {fps:.0f} frames/s and a real server process.
For {minutes:.1f} minutes one of the agents is killed every {gap_s[0]:.0f} to {gap_s[1]:.0f} s, {kills} times,
and started again after {restart_after_s:.0f} s, as by systemd; by themselves they ended
{by_themselves} times. All share this machine's cores with whatever else makes the load: how soon a new
process is ready shows little else.
Sets are whole with the first of ten in a row that lack at most cameras which another kill took away;
a set of all twelve waits for those, too.

{table}

{sets} sets came in {sets_expected} frame intervals. {sets_incomplete} lacked a camera,
{sets_unexplained} of them one that no kill kept away, or for more than 5 s after it was ready.
The server had {resident_mib:.0f} MiB at the end."""


class SupervisedAgent:
    """An agent that is started again whenever and however it ends, as by systemd with Restart=always."""

    def __init__(self, folder: Path, port: int, camera: int) -> None:
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._listener.bind(str(address := folder / f"agent{camera:02d}.notify"))
        self._agent = AgentProcess(
            folder / f"agent{camera:02d}.log",
            port,
            ["--source", "folder", "--path", folder / "rig", "--fps", FPS, "--camera", camera],
            {**os.environ, "NOTIFY_SOCKET": str(address)},
        )
        self._restart_after_s = restart_after_s()
        self._ending = threading.Event()
        self._starting = threading.Lock()
        self.starts_s: list[float] = []
        self.ready_s: list[float] = []
        self._agent.start()
        for loop in (self._restart, self._listen):
            threading.Thread(target=loop, daemon=True).start()

    def kill(self, number: int) -> float:
        """Send a signal; when."""
        kill_s = time.monotonic()
        self._agent.send_signal(number)
        return kill_s

    def close(self) -> None:
        """End it for good."""
        with self._starting:
            self._ending.set()
            self._agent.kill()

    def _restart(self) -> None:
        while True:
            self._agent.wait(None)  # however long it lives
            self._ending.wait(self._restart_after_s)
            with self._starting:
                if self._ending.is_set():
                    return
                self.starts_s.append(time.monotonic())
                self._agent.start()

    def _listen(self) -> None:
        """What it tells its service manager."""
        while True:
            if self._listener.recv(256) == b"READY=1":
                self.ready_s.append(time.monotonic())


def restart_after_s() -> float:
    """What the deployed unit says."""
    unit = (REPOSITORY / "deploy/systemd/rig-agent@.service").read_text()
    found = re.search(r"^RestartSec=(\d+)$", unit, re.M)
    assert found is not None
    assert "Restart=always" in unit
    return float(found.group(1))


@contextmanager
def rig(folder: Path) -> Iterator[tuple[ServerProcess, list[SupervisedAgent]]]:
    """A server and its agents, streaming whole sets."""
    with ExitStack() as stack:
        port = free_port()
        write_small_rig(folder / "rig", CAMERAS, shape=(60, 80))
        server = ServerProcess(folder, port)
        stack.callback(server.stop)
        agents = [SupervisedAgent(folder, port, camera) for camera in range(CAMERAS)]
        for agent in agents:
            stack.callback(agent.close)
        server.steady_since(0.0)
        yield server, agents


def soak(minutes: float) -> dict[str, Any]:
    """Kill agents until the time is over, and look at what the server delivered meanwhile."""
    generator = random.Random(SEED)
    sent: list[tuple[int, str, float]] = []
    loads: list[float] = []
    with tempfile.TemporaryDirectory() as folder, rig(Path(folder)) as (server, agents):
        begin_s = time.monotonic()
        while time.monotonic() < begin_s + 60 * minutes:
            time.sleep(generator.uniform(*GAP_S))
            lately = {camera for camera, _, kill_s in sent if time.monotonic() < kill_s + SETTLE_S}
            camera = generator.choice([one for one in range(CAMERAS) if one not in lately])
            name = generator.choice(list(SIGNALS))
            sent.append((camera, name, agents[camera].kill(SIGNALS[name])))
            loads.append(os.getloadavg()[0])
        server.steady_since(sent[-1][2])
        end_s = time.monotonic()
        kills = [_with_return(agents[one[0]], *one) for one in sent]
        restarts = sum(len(agent.starts_s) for agent in agents)
        sets = server.sets_since(begin_s)
        resident_mib = server.status["resident_kib"] / 1024
    for kill in kills:
        _tell(kill, begin_s, whole_since(kill, kills, sets))
    return {
        "minutes": (end_s - begin_s) / 60,
        "by_signal": {name: _times([k for k in kills if k.signal == name], kills, sets) for name in SIGNALS},
        "all": _times(kills, kills, sets),
        "restarts": restarts,
        "sets": len(sets),
        "sets_expected": round((end_s - begin_s) * FPS),
        "sets_incomplete": sum(1 for one in sets if one.missing),
        "sets_unexplained": len(unexplained(kills, sets)),
        "resident_mib": resident_mib,
        "load_mean": mean(loads),
        "load_max": max(loads),
    }


def _with_return(agent: SupervisedAgent, camera: int, name: str, kill_s: float) -> Kill:
    restart_s = next(time_s for time_s in agent.starts_s if time_s > kill_s)
    return Kill(
        camera, name, kill_s, restart_s, next(time_s for time_s in agent.ready_s if time_s > restart_s)
    )


def _tell(kill: Kill, begin_s: float, whole_s: float | None) -> None:
    whole = "not whole again" if whole_s is None else f"whole after {whole_s - kill.ready_s:.2f} s more"
    print(
        f"{kill.kill_s - begin_s:6.1f} s: {kill.signal} to agent {kill.camera}, "
        f"restarted after {kill.restart_s - kill.kill_s:.2f} s, ready {kill.ready_s - kill.restart_s:.2f} s "
        f"later, {whole}"
    )


def _times(some: Sequence[Kill], kills: Sequence[Kill], sets: Sequence[DeliveredSet]) -> dict[str, Any]:
    """Kills, recoveries, and the times of the latter."""
    whole = [(kill, time_s) for kill in some if (time_s := whole_since(kill, kills, sets)) is not None]
    complete = [time_s - kill.ready_s for kill in some if (time_s := complete_since(kill, sets)) is not None]
    camera = [time_s - kill.ready_s for kill in some if (time_s := camera_since(kill, sets)) is not None]
    from_restart_s = [time_s - kill.restart_s for kill, time_s in whole]
    # The camera may be in the sets before the service manager's process gets to hear of it.
    from_ready_s = [max(0.0, time_s - kill.ready_s) for kill, time_s in whole]
    return {
        "kills": len(some),
        "recovered": len(whole),
        "in_time_from_restart": sum(one <= ALLOWED_S for one in from_restart_s),
        "in_time_from_ready": sum(one <= ALLOWED_S for one in from_ready_s),
        "from_kill_s": _summary([time_s - kill.kill_s for kill, time_s in whole]),
        "from_restart_s": _summary(from_restart_s),
        "from_ready_s": _summary(from_ready_s),
        "camera_from_ready_s": _summary(camera),
        "complete_from_ready_s": _summary(complete),
    }


def _summary(values: Sequence[float]) -> dict[str, float | None]:
    return {"median": median(values), "worst": max(values)} if values else {"median": None, "worst": None}


def page(result: dict[str, Any]) -> str:
    """The section of docs/performance.md."""
    header = ["sets whole again, after s: median / worst (within 5 s)", *SIGNALS, "both"]
    columns = [*result["by_signal"].values(), result["all"]]
    rows = [
        ["kills, of these recovered", *(f"{one['kills']}, {one['recovered']}" for one in columns)],
        ["from the kill", *(_pair(one["from_kill_s"]) for one in columns)],
        ["from the start of the new process", *(_counted(one, "restart") for one in columns)],
        ["from its word that it is ready", *(_counted(one, "ready") for one in columns)],
        [
            "its own camera in the sets, from that word",
            *(_pair(one["camera_from_ready_s"]) for one in columns),
        ],
        ["all twelve in a set, from that word", *(_pair(one["complete_from_ready_s"]) for one in columns)],
    ]
    return _PAGE.format(
        machine=machine(),
        fps=FPS,
        gap_s=GAP_S,
        restart_after_s=restart_after_s(),
        kills=result["all"]["kills"],
        by_themselves=result["restarts"] - result["all"]["kills"],
        table=markdown_table(header, rows),
        **result,
    )


def _counted(one: dict[str, Any], since: str) -> str:
    return f"{_pair(one[f'from_{since}_s'])} ({one[f'in_time_from_{since}']})"


def _pair(summary: dict[str, float | None]) -> str:
    return " / ".join("–" if value is None else f"{value:.2f}" for value in summary.values())


def main() -> None:
    """Soak, record, print; exit status 1 when a kill was not recovered from in time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("minutes", type=float, nargs="?", default=10.0)
    result = soak(parser.parse_args().minutes)
    merge_results({"agent_soak": result})
    write_section("agent-soak", page(result))
    print(page(result))
    if result["all"]["in_time_from_ready"] < result["all"]["kills"]:
        raise SystemExit(f"sets were not whole within {ALLOWED_S:.0f} s of each agent's return")


if __name__ == "__main__":
    main()
