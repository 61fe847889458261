"""What goes wrong in months of running, all of it within two minutes: how long until whole sets come again.

Twelve real `rig-agent` processes play small images at 10 frames/s to a real server process; a relay between
them is the cable. Killed programs, a pulled cable, clocks that jump an hour, a flood of garbage.

Run: python tests/benchmarks/transport_chaos.py [--soak MINUTES]
"""

import argparse
import json
import random
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rig_protocol.datagram import FRAGMENT_PREFIX, VERSION, MessageType
from rig_protocol.testing import Faults
from support.kill_recovery import DeliveredSet
from support.rig_processes import LOOPBACK, AgentProcess, free_port, server_settings, write_small_rig
from support.udp_relay import UdpRelay

CAMERAS, FPS = 12, 10.0
PATIENCE_S = 30.0
STEADY_SETS = 30  # whole sets in a row that count as recovered: longer than any time-out may come late
CABLE_S, FLOOD_S = 3.0, 5.0
FLOOD_PER_S, FLOOD_TICK_S = 50_000, 0.002
HERE = Path(__file__).resolve().parents[1]


class ServerProcess:
    """A server that tells its sets and counters; can be killed and started again."""

    def __init__(self, folder: Path, port: int) -> None:
        self._settings = folder / "settings.json"
        self._settings.write_text(server_settings(port, CAMERAS).model_dump_json())
        self._log = (folder / "server.log").open("ab")
        self._changed = threading.Condition()
        self._sets: list[DeliveredSet] = []
        self.status: dict[str, Any] = {}
        self.start()

    def start(self) -> None:
        """Start it."""
        self._process = subprocess.Popen(
            [sys.executable, str(HERE / "support/set_server.py"), str(self._settings)],
            stdout=subprocess.PIPE,
            stderr=self._log,
        )
        threading.Thread(target=self._read, args=(self._process,), daemon=True).start()

    def send_signal(self, number: int) -> None:
        """Kill it, or make its clock jump."""
        self._process.send_signal(number)
        if number == signal.SIGKILL:
            self._process.wait()

    def stop(self) -> None:
        """End it; harmless when ended."""
        self._process.kill()
        self._process.wait()
        self._log.close()

    def steady_since(self, start_s: float) -> float:
        """When the first of some whole sets in a row after `start_s` was delivered, awaited."""
        with self._changed:
            found = self._changed.wait_for(lambda: self._steady(start_s) is not None, PATIENCE_S)
            steady_s = self._steady(start_s)
        if not found or steady_s is None:
            missing = self.status.get("often_missing")
            raise SystemExit(f"no whole sets within {PATIENCE_S:.0f} s; often missing: {missing}")
        return steady_s

    def sets_since(self, start_s: float) -> list[DeliveredSet]:
        """What was delivered, in order."""
        with self._changed:
            return [one for one in self._sets if one.time_s >= start_s]

    def incomplete_since(self, start_s: float) -> int:
        """Sets that lacked a camera."""
        return sum(1 for one in self.sets_since(start_s) if one.missing)

    def _steady(self, start_s: float) -> float | None:
        run: list[float] = []
        for one in self._sets:
            if one.time_s >= start_s:
                run = [] if one.missing else [*run, one.time_s]
                if len(run) == STEADY_SETS:
                    return run[0]
        return None

    def _read(self, process: subprocess.Popen[bytes]) -> None:
        for line in process.stdout or ():
            told = json.loads(line)
            with self._changed:
                if "missing" in told:
                    self._sets.append(DeliveredSet(told["t"], frozenset(told["missing"])))
                elif "status" in told:
                    self.status = {**told["status"], "resident_kib": told["resident_kib"]}
                self._changed.notify_all()


class Rig:
    """Server, cable and twelve agents."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        port = free_port()
        write_small_rig(folder / "rig", CAMERAS, shape=(60, 80))
        self.server = ServerProcess(folder, port)
        stack.callback(self.server.stop)
        self.port = port
        self.cable = stack.enter_context(UdpRelay((LOOPBACK, port), Faults(delay_ns=0)))
        options = ["--source", "folder", "--path", folder / "rig", "--fps", FPS, "--camera"]
        self.agents = [
            AgentProcess(folder / f"agent{i:02d}.log", self.cable.port, [*options, i], stepping=True)
            for i in range(CAMERAS)
        ]
        for agent in self.agents:
            agent.start()
            stack.callback(agent.kill)

    def counted(self, name: str) -> int:
        """A counter of all cameras."""
        return sum(camera[name] for camera in self.server.status.get("cameras", ()))


def kill_agent(rig: Rig) -> None:
    """An agent's power fails for a moment."""
    rig.agents[3].kill()
    rig.agents[3].start()


def kill_server(rig: Rig) -> None:
    """The server is killed and started by its service manager."""
    rig.server.send_signal(signal.SIGKILL)
    rig.server.start()


def pull_cable(rig: Rig) -> None:
    """All agents lose the server for three seconds."""
    rig.cable.unplugged.set()
    time.sleep(CABLE_S)
    rig.cable.unplugged.clear()


def agent_clock(number: int) -> Callable[[Rig], None]:
    """One agent's clock jumps."""
    return lambda rig: rig.agents[5].send_signal(number)


def server_clock(number: int) -> Callable[[Rig], None]:
    """The server's clock jumps."""
    return lambda rig: rig.server.send_signal(number)


def flood(rig: Rig) -> None:
    """A stranger sends 50,000 datagrams a second beside the stream."""
    datagrams = _garbage()
    at_once = round(FLOOD_PER_S * FLOOD_TICK_S)
    start_s, sent = time.monotonic(), 0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.connect((LOOPBACK, rig.port))
        while (elapsed_s := time.monotonic() - start_s) < FLOOD_S:
            for _ in range(min(at_once * 4, round(elapsed_s * FLOOD_PER_S) - sent)):
                stranger.send(datagrams[sent % len(datagrams)])
                sent += 1
            time.sleep(FLOOD_TICK_S)
    rig.flooded = sent  # type: ignore[attr-defined]


def _garbage() -> list[bytes]:
    """Noise, fragments of unknown sessions, hellos of another key, torn prefixes."""
    generator = random.Random(1)
    prefix = b"KR" + bytes((VERSION,))
    kinds = [
        lambda: generator.randbytes(generator.randrange(1472)),
        lambda: FRAGMENT_PREFIX + generator.randbytes(1468),
        lambda: prefix + bytes((generator.choice(list(MessageType)),)) + generator.randbytes(600),
        lambda: prefix[: generator.randrange(4)],
    ]
    return [generator.choice(kinds)() for _ in range(1000)]


CASES: dict[str, Callable[[Rig], None]] = {
    "agent killed": kill_agent,
    "server killed": kill_server,
    "cable pulled for 3 s": pull_cable,
    "agent's clock 1 h ahead": agent_clock(signal.SIGUSR1),
    "agent's clock 1 h back": agent_clock(signal.SIGUSR2),
    "server's clock 1 h ahead": server_clock(signal.SIGUSR1),
    "server's clock 1 h back": server_clock(signal.SIGUSR2),
    "50,000 garbage datagrams/s for 5 s": flood,
}


def run(advance: Callable[[], None] = lambda: None) -> list[dict[str, Any]]:
    """The section `chaos` of bench.json; `advance` is called after each of `len(CASES)` cases."""
    results = []
    with _rig() as rig:
        for name, disturb in CASES.items():
            start_s = time.monotonic()
            disturb(rig)
            # A fault that lasts is over when `disturb` returns; one that strikes is, too.
            over_s = time.monotonic()
            recovered_s = max(0.0, rig.server.steady_since(over_s) - over_s)
            results.append(
                {
                    "case": name,
                    "recovered_s": recovered_s,
                    "incomplete_sets": rig.server.incomplete_since(start_s),
                    "resident_mib": rig.server.status.get("resident_kib", 0) / 1024,
                }
            )
            advance()
    return results


@contextmanager
def _rig() -> Iterator[Rig]:
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        rig = Rig(Path(folder), stack)
        rig.server.steady_since(0.0)
        yield rig


def soak(minutes: float) -> None:
    """All cases in random order until the time is over: prints memory and what was lost."""
    generator, end_s = random.Random(0), time.monotonic() + 60 * minutes
    with _rig() as rig:
        while time.monotonic() < end_s:
            name = generator.choice(list(CASES))
            CASES[name](rig)
            over_s = time.monotonic()
            recovered_s = rig.server.steady_since(over_s) - over_s
            resident_mib = rig.server.status.get("resident_kib", 0) / 1024
            print(
                f"{name}: whole sets after {recovered_s:.2f} s, resident {resident_mib:.0f} MiB", flush=True
            )


def main() -> None:
    """Print the table, or soak."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--soak", type=float, metavar="MINUTES", help="go on for so long")
    minutes = parser.parse_args().soak
    if minutes is None:
        print(json.dumps(run(), indent=1))
    else:
        soak(minutes)


if __name__ == "__main__":
    main()
