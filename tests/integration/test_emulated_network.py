"""Real agents on twelve hosts, a switch, a PC with a real server: a network out of namespaces."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from rig_protocol.frames import RgbdFrame
from rig_server import Rig
from support.network_namespaces import existing_namespaces, remove_stale, why_unavailable
from support.rig_processes import (
    any_set,
    folder_agents,
    holds_only_written_images,
    is_complete,
    server_settings,
    wait_for_set,
    write_small_rig,
)
from support.virtual_network import (
    MTU_PAYLOAD,
    PC,
    PC_ADDRESS,
    WIRE_OVERHEAD,
    VirtualNetwork,
    host_name,
)

pytestmark = pytest.mark.skipif(why_unavailable() is not None, reason=str(why_unavailable()))

PORT = 4012
CAMERAS = 12
FPS = 5.0
_ADDRESS_RESOLUTION = 4  # frames of ARP that may pass among those that are counted
# Sends bursts of 44 datagrams without a pause; prints how many bursts, and in how many seconds.
BLAST = """
import socket, struct, sys, time
host, port, seconds = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
data, cut = bytes(44 * 1472), [(17, 103, struct.pack("=H", 1472))]
bursts, begin_s = 0, time.monotonic()
while bursts == 0 or time.monotonic() < begin_s + seconds:
    out.sendmsg([data], cut, 0, (host, port))
    bursts += 1
print(bursts, time.monotonic() - begin_s)
"""
# Builds a network with a process in it, says so, and waits.
BUILD = """
import subprocess, time
from support.virtual_network import VirtualNetwork
with VirtualNetwork(hosts=1) as network:
    process = network.run_in("host00", ["sh", "-c", "echo inside; exec sleep 600"], stdout=subprocess.PIPE)
    process.stdout.readline()  # before it says so, it may not be in the network yet
    print(process.pid, flush=True)
    time.sleep(600)
"""


@dataclass
class EmulatedRig:
    """Twelve agents that stream to a rig whose socket is the PC's."""

    network: VirtualNetwork
    rig: Rig
    written: list[RgbdFrame]

    def wait_until_whole(self, timeout_s: float = 60.0) -> None:
        """Await a complete set that holds what was written."""
        assert holds_only_written_images(wait_for_set(self.rig, is_complete, timeout_s), self.written)


@pytest.fixture(scope="module")
def emulated(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EmulatedRig]:
    folder, logs = tmp_path_factory.mktemp("rig"), tmp_path_factory.mktemp("logs")
    written = write_small_rig(folder)
    with VirtualNetwork(CAMERAS) as network:
        with network.inside(PC):
            rig = Rig.live(server_settings(PORT, CAMERAS, listen=f"{PC_ADDRESS}:{PORT}"))
        agents = folder_agents(
            folder,
            logs,
            PORT,
            range(CAMERAS),
            FPS,
            host=PC_ADDRESS,
            prefix=lambda i: network.prefix(host_name(i)),
        )
        with rig, agents:
            rig.wait_for_cameras()
            yield EmulatedRig(network, rig, written)


def test_the_port_sends_at_its_rate_on_the_wire_and_drops_what_its_buffer_cannot_hold() -> None:
    """The emulation itself, at a rate that one sender on a busy machine exceeds tenfold."""
    link_mbit, buffer_bytes = 100, 128 * 1024
    with (
        VirtualNetwork(hosts=1, link_mbit=link_mbit, buffer_kib=128) as network,
        network.inside(PC),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as pc,
    ):
        pc.bind((PC_ADDRESS, PORT))
        assert blast(network, seconds=0) == (44, pytest.approx(0, abs=1))
        assert network.port().dropped == 0  # 66 KiB fit into the buffer
        before = network.port()
        sent, elapsed_s = blast(network, seconds=0.5)
        wait_until_drained(network)
        port = network.port().since(before)
    assert 0 <= port.datagrams + port.dropped - sent <= _ADDRESS_RESOLUTION
    wire_bytes = port.datagrams * (MTU_PAYLOAD + WIRE_OVERHEAD)
    assert wire_bytes - _ADDRESS_RESOLUTION * MTU_PAYLOAD <= port.wire_bytes <= wire_bytes
    rate_bytes = link_mbit * 1e6 / 8
    assert port.wire_bytes <= rate_bytes * elapsed_s + buffer_bytes
    assert port.wire_bytes >= rate_bytes * elapsed_s * 0.8  # the timer of a busy machine is late


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGKILL])
def test_nothing_of_a_network_outlives_the_process_that_built_it(end: signal.Signals) -> None:
    """Ctrl-C removes it at once; what a killed process left is removed by whoever comes next."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    words = [sys.executable, "-c", BUILD]
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment
    ) as builder:
        assert builder.stdout is not None
        inner = Path(f"/proc/{int(builder.stdout.readline())}")
        assert inner.exists()
        builder.send_signal(end)
        builder.wait(timeout=30)
    if end == signal.SIGKILL:
        remove_stale()
    assert not any(f"-{builder.pid}-" in name for name in existing_namespaces())
    wait_until(lambda: not is_running(inner), "the process in the network still runs")


def test_twelve_hosts_deliver_complete_bit_exact_sets_through_one_port(emulated: EmulatedRig) -> None:
    before = emulated.network.port()
    for _ in range(10):
        emulated.wait_until_whole()
    port = emulated.network.port().since(before)
    assert port.datagrams > 10 * CAMERAS  # through this switch and no other way
    assert port.dropped == 0


def test_a_host_without_its_cable_is_named_as_missing_and_comes_back(emulated: EmulatedRig) -> None:
    emulated.wait_until_whole()
    emulated.network.pull_cable(host_name(3))
    wait_for_set(emulated.rig, lambda panorama: panorama.missing == (3,))
    wait_for_no_longer_connected(emulated.rig, 3)
    emulated.network.plug_cable(host_name(3))
    emulated.wait_until_whole(timeout_s=10)


def test_every_camera_comes_back_after_the_servers_cable_was_out(emulated: EmulatedRig) -> None:
    emulated.wait_until_whole()
    emulated.network.pull_cable(PC)
    for camera in range(CAMERAS):
        wait_for_no_longer_connected(emulated.rig, camera)
    emulated.network.plug_cable(PC)
    emulated.wait_until_whole(timeout_s=10)


def test_a_network_that_loses_one_datagram_in_a_hundred_costs_no_frame(emulated: EmulatedRig) -> None:
    emulated.wait_until_whole()
    with emulated.network.loss(percent=1):
        seen = [wait_for_set(emulated.rig, any_set) for _ in range(20)]
        assert emulated.network.lost_at_random() > 100
    assert all(panorama.complete for panorama in seen)
    assert all(holds_only_written_images(panorama, emulated.written) for panorama in seen)


def blast(network: VirtualNetwork, seconds: float) -> tuple[int, float]:
    """Datagrams that host 0 sent as fast as it could, at least 44, and in what time."""
    words = [sys.executable, "-c", BLAST, PC_ADDRESS, str(PORT), str(seconds)]
    with network.run_in(host_name(0), words, stdout=subprocess.PIPE) as process:
        printed, _ = process.communicate(timeout=30)
    bursts, elapsed_s = printed.split()
    return 44 * int(bursts), float(elapsed_s)


def wait_until_drained(network: VirtualNetwork) -> None:
    """Until the port has sent what it had queued: until its counters rest."""
    before, now = None, network.port()
    while now != before:
        time.sleep(0.05)  # longer than a full buffer takes
        before, now = now, network.port()


def is_running(process: Path) -> bool:
    """Whether a process is there and no zombie, by its folder in /proc."""
    try:
        return (process / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_for_no_longer_connected(rig: Rig, camera: int) -> None:
    """Until the server has given the camera up, which frees whatever it kept for it."""
    wait_until(lambda: not rig.status().cameras[camera].connected, f"camera {camera} is still connected")


def wait_until(happened: Callable[[], bool], complaint: str) -> None:
    """Ask until it is so; AssertionError after ten seconds."""
    until_s = time.monotonic() + 10
    while not happened():
        assert time.monotonic() < until_s, complaint
        time.sleep(0.02)
