"""Coverage-guided fuzzing (atheris) of everything that parses bytes of strangers.

python tests/fuzz/fuzz_parsers.py TARGET [libFuzzer options], for example -max_total_time=120

A target fails by any exception other than RigError and its kin, by a broken invariant, by 2 GiB of memory or
by 10 s for one input. `make fuzz` gives each target two minutes; a failing input is left in build/fuzz/.
"""

import io
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import atheris

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

with atheris.instrument_imports(include=["rig_protocol"], enable_loader_override=False):
    from rig_protocol.agent_link import AgentLink
    from rig_protocol.camera import CameraModel
    from rig_protocol.codecs import COLOR_CODECS, DEPTH_CODECS, codec
    from rig_protocol.datagram import DatagramBatch, MessageType, pack_prefix
    from rig_protocol.errors import DataError, RigError
    from rig_protocol.events import FrameReceived
    from rig_protocol.frame_unit import pack_unit, parse_unit
    from rig_protocol.frames import EncodedFrame, Payload
    from rig_protocol.mcap_scan import scan
    from rig_protocol.message_bytes import decode_body, encode_body
    from rig_protocol.reassembler import MAX_OPEN_UNITS
    from rig_protocol.recorded_hellos import recorded_hellos, told_hellos
    from rig_protocol.recorded_sets import with_frames
    from rig_protocol.recording import DESCRIPTION, HELLOS, Recording, RecordingWriter, recover
    from rig_protocol.recording_format import ClockReading, ClockTie, DroppedFrames, RecordedSet, pack_entry
    from rig_protocol.rig_folder import CameraEntry, RigDescription
    from rig_protocol.rig_key import RigKey
    from rig_protocol.server_link import ServerLink

import numpy as np

from support.wire import (
    AGENT,
    OTHER,
    T0,
    events_of,
    make_agent,
    make_frame,
    make_hello,
    make_server,
    roundtrip,
)

_CRASHES = Path("build/fuzz")
_OPTIONS = ("-timeout=10", "-rss_limit_mb=2048", "-print_final_stats=1")
_CODECS = (*COLOR_CODECS, *DEPTH_CODECS)
_BODIES = tuple(MessageType(k) for k in range(1, 11))
_MAX_PIXELS = 4096 * 4096


def _pieces(data: bytes) -> Iterator[bytes]:
    """Inputs as several datagrams: each led by its length in two bytes."""
    while len(data) > 2:
        size = 1 + int.from_bytes(data[:2], "little") % 1500
        yield data[2 : 2 + size]
        data = data[2 + size :]


def _joined(pieces: list[bytes]) -> bytes:
    return b"".join((len(piece) - 1).to_bytes(2, "little") + piece for piece in pieces)


class _Connected:
    """Two ends with a session, made anew every hundred inputs: a handshake takes longer than an input."""

    def __init__(self) -> None:
        self._used = 0

    def links(self) -> tuple[AgentLink, ServerLink, int]:
        """Both ends and the session id."""
        if self._used % 100 == 0:
            self._agent, self._server = make_agent(), make_server()
            roundtrip(self._agent, self._server)
            events_of(self._server)
        self._used += 1
        assert self._agent.session is not None
        return self._agent, self._server, self._agent.session.session_id


_connected = _Connected()


def server_link(data: bytes) -> None:
    """A connected server takes datagrams of strangers, some from its agent's address: no frame comes."""
    _, server, session_id = _connected.links()
    now_ns = T0
    for k, piece in enumerate(_pieces(data)):
        now_ns += 1_000
        address = (AGENT, OTHER)[k % 2]
        # What is after the prefix is the fuzzer's; half of the time it knows the session.
        known = pack_prefix(MessageType.FRAGMENT, 0, session_id) if k % 3 else b""
        server.receive_batch(DatagramBatch(known + piece, len(known + piece)), address, now_ns)
        server.handle_timeout(now_ns)
        server.datagrams_to_send(now_ns)
    assert not any(isinstance(event, FrameReceived) for event in events_of(server))
    for session in server._sessions:
        assert len(session._reassembler._open) <= MAX_OPEN_UNITS


def agent_link(data: bytes) -> None:
    """A connected agent takes datagrams in its server's name: its session must outlive them."""
    agent, _, session_id = _connected.links()
    for k, piece in enumerate(_pieces(data)):
        known = pack_prefix(MessageType(1 + k % 10), 0, session_id) if k % 3 else b""
        agent.receive_datagram(known + piece, T0 + k)
        agent.handle_timeout(T0 + k)
        agent.datagrams_to_send(T0 + k)
    assert agent.connected


def bodies(data: bytes) -> None:
    """The body of every control message, as if it were authentic."""
    if data:
        decode_body(_BODIES[data[0] % len(_BODIES)], data[1:])


def units(data: bytes) -> None:
    """A frame's unit, as if it were authentic."""
    frame = parse_unit(data, 0)
    assert sum(len(payload.data) for payload in (frame.color, frame.depth) if payload) <= len(data)


def codecs(data: bytes) -> None:
    """The payload of every codec, as if it were authentic."""
    if data:
        image = codec(_CODECS[data[0] % len(_CODECS)]).decode(data[1:])
        assert image.shape[0] * image.shape[1] <= _MAX_PIXELS


def key_files(data: bytes) -> None:
    """The text of a key file."""
    RigKey.parse(data.decode("ascii", errors="replace"))


def recordings(data: bytes) -> None:
    """A file that claims to be a take: read, asked for all that it tells, and mended."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "take.mcap")
        path.write_bytes(data)
        try:
            _read_take(path)
        except DataError:
            recover(path)  # it may refuse, too
            _read_take(path)


def _read_take(path: Path) -> None:
    recording = Recording(path)
    for entry in recording.entries():
        assert pack_entry(entry)  # what was read can be written
    if recording.has_sets:
        for one in with_frames(recording.entries()):
            assert any(one.frames.values())
    recorded_hellos(recording.document(HELLOS), recording.description)
    assert recording.start_ns <= recording.end_ns
    recording.utc_minus_rig_time_ns  # noqa: B018  # it parses


TARGETS: dict[str, Callable[[bytes], None]] = {
    each.__name__: each for each in (server_link, agent_link, bodies, units, codecs, key_files, recordings)
}


def _seeds(target: str) -> list[bytes]:
    """Inputs that get far: what honest ends send."""
    agent, server = make_agent(), make_server()
    hello = agent.datagrams_to_send(T0)
    for datagram in hello:
        server.receive_datagram(datagram, AGENT, T0)
    answers = [datagram for datagram, _ in server.datagrams_to_send(T0)]
    for answer in answers:
        agent.receive_datagram(answer, T0)
    roundtrip(agent, server)
    batch = agent.send_frame(make_frame(size=3000), T0)
    image = np.arange(35, dtype=np.uint8).reshape(5, 7)
    by_target = {
        "server_link": [_joined(hello), _joined([bytes(one)[16:] for one in batch or ()])],
        "agent_link": [_joined(answers)],
        "bodies": [bytes([0]) + encode_body(make_hello())[1]],
        "units": [pack_unit(make_frame(size=300))],
        "codecs": [bytes([k]) + codec(id_).encode(_image(id_, image)) for k, id_ in enumerate(_CODECS)],
        "recordings": [*_takes()],
        "key_files": [RigKey.INSECURE.to_text().encode()],
    }
    return by_target[target]


def _takes() -> Iterator[bytes]:
    """A small take, finished and torn; without check sums, which would keep the fuzzer out of its chunks."""
    camera = CameraEntry(3, "cam03", CameraModel())
    for finish in (True, False):
        output = io.BytesIO()
        writer = RecordingWriter(output, "2026-01-02", 5, "agent")
        writer.attach(DESCRIPTION, RigDescription((camera,)).to_dict(), 5)
        writer.attach(HELLOS, told_hellos({3: make_hello(camera_id=3)}), 5)
        for k in range(2):
            frame = EncodedFrame(3, k, 9 + k, color=Payload(1, b"color"), depth=Payload(2, b"depth"))
            writer.write(frame)
            writer.write(RecordedSet(k, 10 + k, {3: frame.timestamp_ns, 4: None}))
        writer.write(ClockReading(12, (ClockTie("utc", 1, 2),)))
        writer.write(DroppedFrames(3, 1, 2, 3))
        writer.flush()
        if finish:
            writer.finish()
        yield _without_check_sums(output.getvalue())


def _without_check_sums(take: bytes) -> bytes:
    changed = bytearray(take)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "take.mcap")
        path.write_bytes(take)
        for chunk in scan(path).chunks:
            changed[chunk.offset + 24 : chunk.offset + 28] = bytes(4)
    return bytes(changed)


def _image(codec_id: int, image: "np.ndarray") -> "np.ndarray":
    kind = codec(codec_id).image
    if kind in ("raw", "depth_mm"):
        return image.astype(np.uint16)
    return np.dstack([image] * 3) if kind == "bgr" else image[:4, :6] if kind == "bayer" else image


def main() -> None:
    """Fuzz one target."""
    name, options = sys.argv[1], sys.argv[2:]
    target = TARGETS[name]

    def one_input(data: bytes) -> None:
        try:
            target(data)
        except RigError:
            return  # the honest answer

    seeds = _seeds(name)
    longest = max(4096, *map(len, seeds))
    _CRASHES.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as corpus:
        for k, seed in enumerate(seeds):
            (Path(corpus) / f"seed{k}").write_bytes(seed)
        words = [
            sys.argv[0],
            *_OPTIONS,
            f"-max_len={longest}",
            f"-artifact_prefix={_CRASHES}/{name}-",
            *options,
            corpus,
        ]
        atheris.Setup(words, one_input)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
