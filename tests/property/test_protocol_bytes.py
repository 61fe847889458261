"""Whatever bytes arrive: nothing escapes a link, memory is bounded, no altered frame is accepted."""

from collections import Counter
from contextlib import suppress
from typing import Any

import msgpack
from hypothesis import given, settings
from hypothesis import strategies as st

from rig_protocol.clear_datagram import clear_crc, encode_clear
from rig_protocol.clock_sync import ClockSync
from rig_protocol.counters import CameraCounters
from rig_protocol.datagram import (
    MAGIC,
    VERSION,
    DatagramBatch,
    FragmentHeader,
    MessageType,
    consecutive_runs,
    pack_fragment_header,
    pack_prefix,
    parse_fragment_header,
)
from rig_protocol.errors import DataError
from rig_protocol.events import FrameReceived
from rig_protocol.fragmenter import fragment
from rig_protocol.frame_unit import MAX_SEALED_SIZE, MIN_SEALED_SIZE, parse_unit
from rig_protocol.frames import EncodedFrame, Payload
from rig_protocol.message_bytes import decode_body, encode_body
from rig_protocol.messages import ClockReply
from rig_protocol.reassembler import MAX_OPEN_UNITS, Reassembler
from rig_protocol.security import hello_aead, seal_once
from support.peers import AgentPeer, ServerPeer
from support.wire import (
    AGENT,
    KEY,
    OTHER,
    T0,
    events_of,
    make_agent,
    make_frame,
    make_hello,
    make_seal,
    make_server,
    roundtrip,
)

examples = settings(deadline=None, derandomize=True, max_examples=150)

SEAL = make_seal()
U64 = st.integers(0, 2**64 - 1)
I64 = st.integers(-(2**63), 2**63 - 1)
ANYTHING = st.recursive(
    st.none() | st.booleans() | I64 | st.floats() | st.text(max_size=20) | st.binary(max_size=20),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=8), inner, max_size=5),
    max_leaves=20,
)
HELLO_VALUES: dict[str, Any] = msgpack.unpackb(encode_body(make_hello())[1])


def with_crc(datagram: bytes) -> bytes:
    """The datagram with the crc that it should have, so that what stands behind the crc is reached."""
    return datagram[:4] + clear_crc(datagram).to_bytes(4, "little") + datagram[8:]


@st.composite
def datagrams(draw: st.DrawFn, id_: int) -> bytes:
    """Bytes that look like the protocol's to every depth: from noise to a right crc over a wild body."""
    kind = draw(st.sampled_from([*MessageType, 0, 99]))
    version = draw(st.sampled_from([VERSION, VERSION, VERSION, 0, 1, 255]))
    body = draw(st.binary(max_size=600) | st.builds(msgpack.packb, ANYTHING))
    start = (
        MAGIC + bytes((version, kind)) + bytes(4) + draw(st.sampled_from([id_, id_, 7])).to_bytes(8, "little")
    )
    whole = with_crc(start + body)
    return draw(
        st.sampled_from([whole, whole, start + body, body, whole[: draw(st.integers(0, len(whole)))]])
    )


@examples
@given(st.data())
def test_nothing_escapes_the_server_and_no_answer_is_longer_than_its_cause(data: st.DataObject) -> None:
    server, agent = make_server(), make_agent()
    roundtrip(agent, server)
    assert agent.session is not None
    for _ in range(8):
        datagram = data.draw(datagrams(agent.session.session_id))
        address = data.draw(st.sampled_from([AGENT, OTHER]))
        server.receive_datagram(datagram, address, T0)
        for answer, to in server.datagrams_to_send(T0):
            assert to in (AGENT, OTHER)
            assert len(answer) <= len(datagram)
        server.handle_timeout(T0)
        server.datagrams_to_send(T0)  # what time brings: clock requests and resends of the session
        events_of(server)


@examples
@given(st.data(), st.booleans())
def test_nothing_escapes_the_agent(data: st.DataObject, connected: bool) -> None:
    server, agent = make_server(), make_agent()
    nonce = int.from_bytes(agent.datagrams_to_send(T0)[0][8:16], "little")
    if connected:
        roundtrip(agent, server, now_ns=T0 + 10**9)
    for _ in range(8):
        id_ = agent.session.session_id if agent.session else nonce
        agent.receive_datagram(data.draw(datagrams(id_)), T0)
        agent.datagrams_to_send(T0)
        agent.handle_timeout(T0)
        agent.send_frame(make_frame(size=10), T0)
        agent.frames_to_resend(len)
        events_of(agent)


FROM_AGENT = [
    MessageType.GOODBYE,
    MessageType.HEARTBEAT,
    MessageType.CLOCK_REPLY,
    MessageType.CONTROL_RESULT,
]
FROM_SERVER = [
    MessageType.GOODBYE,
    MessageType.CLOCK_REQUEST,
    MessageType.RESEND,
    MessageType.PLAN,
    MessageType.CONTROL,
]
BODIES = st.binary(max_size=300) | st.builds(msgpack.packb, ANYTHING)


@examples
@given(st.lists(st.tuples(st.sampled_from(FROM_AGENT), BODIES), max_size=6))
def test_no_authentic_agent_brings_down_the_server(said: list[tuple[MessageType, bytes]]) -> None:
    server, agent = make_server(), AgentPeer()
    server.receive_datagram(agent.hello, AGENT, T0)
    agent.accept(server.datagrams_to_send(T0)[0][0])
    for now_ns, (kind, body) in enumerate(said, start=T0):
        server.receive_datagram(agent.seal_body(kind, body), AGENT, now_ns)
        server.handle_timeout(now_ns)
        server.datagrams_to_send(now_ns)
        events_of(server)


@examples
@given(st.lists(st.tuples(st.sampled_from(FROM_SERVER), BODIES), max_size=6))
def test_no_authentic_server_brings_down_the_agent_or_makes_it_send_more_than_its_budget(
    said: list[tuple[MessageType, bytes]],
) -> None:
    server, agent = ServerPeer(), make_agent()
    agent.receive_datagram(server.welcome(agent.datagrams_to_send(T0)[0]), T0)
    sent_again = 0
    for now_ns, (kind, body) in enumerate(said, start=T0):
        agent.receive_datagram(server.seal_body(kind, body), now_ns)
        agent.send_frame(make_frame(), now_ns)
        sent_again += sum(map(len, agent.frames_to_resend(len)))
        agent.handle_timeout(now_ns)
        agent.datagrams_to_send(now_ns)
        events_of(agent)
    assert sent_again <= 3 * (1 + len(said))


@examples
@given(st.sampled_from([kind for kind in MessageType if kind is not MessageType.FRAGMENT]), BODIES)
def test_any_structure_is_a_message_or_malformed(kind: MessageType, body: bytes) -> None:
    with suppress(DataError):
        decode_body(kind, body)


@examples
@given(st.data())
def test_a_hello_with_any_value_replaced_is_a_message_or_malformed(data: st.DataObject) -> None:
    values = msgpack.unpackb(msgpack.packb(HELLO_VALUES))
    place: Any = values
    while True:
        keys = list(place) if isinstance(place, dict) else list(range(len(place)))
        key = data.draw(st.sampled_from(keys))
        if not isinstance(place[key], dict | list) or not place[key] or data.draw(st.booleans()):
            break
        place = place[key]
    place[key] = data.draw(ANYTHING)
    public, server = bytes(range(32)), make_server()
    associated = pack_prefix(MessageType.HELLO, 0, 1) + public
    sealed = seal_once(hello_aead(KEY, public), msgpack.packb(values), associated)
    server.receive_datagram(encode_clear(MessageType.HELLO, public + sealed, 1), AGENT, T0)
    assert len(server.datagrams_to_send(T0)) <= 1


@st.composite
def frames(draw: st.DrawFn) -> EncodedFrame:
    """Any frame that may be sent."""
    payload = st.none() | st.builds(Payload, st.integers(1, 255), st.binary(max_size=6000))
    return EncodedFrame(
        camera_id=0,
        sequence=draw(U64),
        timestamp_ns=draw(I64),
        uncertainty_ns=draw(st.integers(0, 2**32 - 1)),
        color=draw(payload),
        depth=draw(payload),
        depth_frame=draw(st.sampled_from(["depth", "color"])),
        damaged=draw(st.booleans()),
    )


@examples
@given(frames(), U64, U64, st.integers(1200, 9000), st.data())
def test_a_frame_survives_any_order_with_repetitions(
    frame: EncodedFrame, session_id: int, number: int, datagram_size: int, data: st.DataObject
) -> None:
    sent = [bytes(datagram) for datagram in fragment(frame, session_id, number, SEAL, datagram_size)]
    order = data.draw(st.permutations(range(len(sent))))
    repeated = data.draw(st.lists(st.sampled_from(range(len(sent))), max_size=4))
    delivered = feed(make_reassembler(), [sent[k] for k in [*repeated, *order, *repeated]])
    assert delivered == [frame]


def make_reassembler() -> Reassembler:
    return Reassembler(0, 30.0, CameraCounters(), SEAL)


def feed(reassembler: Reassembler, datagrams_: list[bytes], now_ns: int = 0) -> list[EncodedFrame]:
    """Frames that come out when datagrams go in one by one."""
    delivered = []
    for datagram in datagrams_:
        header = parse_fragment_header(datagram)
        frame = None if header is None else reassembler.receive(header, datagram, 1, now_ns)
        if frame is not None:
            delivered.append(frame)
    return delivered


@examples
@given(st.data())
def test_altered_bytes_never_become_an_accepted_altered_frame(data: st.DataObject) -> None:
    server, agent = make_server(), make_agent()
    roundtrip(agent, server)
    events_of(server)
    originals = {k: make_frame(k, timestamp_ns=T0) for k in range(3)}
    sent = []
    for frame in originals.values():
        batch = agent.send_frame(frame, T0)
        assert batch is not None
        sent += [bytearray(datagram) for datagram in batch]
    for _ in range(data.draw(st.integers(1, 5))):
        datagram = data.draw(st.sampled_from(sent))
        where = data.draw(st.integers(0, len(datagram) - 1))
        match data.draw(st.sampled_from(["flip", "cut", "insert", "copy"])):
            case "flip":
                datagram[where] ^= data.draw(st.integers(1, 255))
            case "cut":
                del datagram[max(1, where) :]
            case "insert":
                datagram[where:where] = data.draw(st.binary(min_size=1, max_size=9))
            case "copy":
                other = data.draw(st.sampled_from(sent))
                datagram[where : where + 40] = other[where : where + 40]
    for datagram in sent:
        server.receive_datagram(bytes(datagram), AGENT, T0)
    for event in events_of(server):
        if isinstance(event, FrameReceived):
            original = originals[event.frame.sequence]
            assert (event.frame.color, event.frame.depth) == (original.color, original.depth)
            assert event.frame.timestamp_ns == T0


HEADERS = st.builds(
    FragmentHeader,
    seal=st.integers(0, 3),
    session_id=st.just(1),
    frame_number=st.integers(0, 40) | U64,
    unit_size=st.sampled_from(
        [
            0,
            1,
            MIN_SEALED_SIZE - 1,
            MIN_SEALED_SIZE,
            100,
            1441,
            MAX_SEALED_SIZE,
            MAX_SEALED_SIZE + 1,
            2**32 - 1,
        ]
    ),
    payload_size=st.sampled_from([0, 1, 32, 33, 68, 1440, 65535]),
    fragment_index=st.integers(0, 3) | st.integers(0, 65535),
)


@examples
@given(st.lists(st.tuples(HEADERS, st.sampled_from([0, 1, 31, 32, 33, 48, 68, 100, 1440])), max_size=60))
def test_any_headers_leave_the_reassembler_within_its_bounds(items: list[tuple[FragmentHeader, int]]) -> None:
    reassembler = make_reassembler()
    for k, (header, size) in enumerate(items):
        now_ns = k * 700_000
        feed(reassembler, [pack_fragment_header(header) + bytes(size)], now_ns)
        if reassembler.due_ns <= now_ns:
            for request in reassembler.handle_timeout(now_ns):
                encode_body(request)  # raises where it could not be sent
        assert reassembler.due_ns > now_ns
        assert len(reassembler._open) <= MAX_OPEN_UNITS
        held = [len(unit.content) for unit in reassembler._open.values()]
        assert sum(held) <= MAX_OPEN_UNITS * MAX_SEALED_SIZE


@examples
@given(st.lists(st.tuples(HEADERS, st.integers(1, 4)), max_size=12), st.sampled_from([33, 64, 100, 1472]))
def test_a_batch_has_the_same_effect_as_its_datagrams_alone(
    items: list[tuple[FragmentHeader, int]], size: int
) -> None:
    together, alone = make_server(), make_server()
    for server in (together, alone):
        roundtrip(make_agent(), server)
    [session] = together._sessions  # the seeds are the same: so is the id
    headers = [
        header._replace(
            session_id=session.welcome.session_id, fragment_index=(header.fragment_index + k) % 65536
        )
        for header, length in items
        for k in range(length)
    ]
    content = b"".join(pack_fragment_header(header) + bytes(size - 32) for header in headers)
    batch = DatagramBatch(content, size)
    together.receive_batch(batch, AGENT, T0)
    for datagram in batch:
        alone.receive_datagram(datagram, AGENT, T0)
    assert together.rejected == alone.rejected
    assert together.cameras[0].counters == alone.cameras[0].counters


@examples
@given(st.binary(max_size=400), st.integers(1, 80))
def test_a_batch_of_any_bytes_has_the_same_effect_as_its_datagrams_alone(content: bytes, size: int) -> None:
    together, alone = make_server(), make_server()
    batch = DatagramBatch(content, size)
    together.receive_batch(batch, AGENT, T0)
    for datagram in batch:
        alone.receive_datagram(datagram, AGENT, T0)
    assert together.rejected == alone.rejected
    assert sum(count for count, _ in consecutive_runs(batch)) == len(batch)
    assert Counter(together.rejected).total() == len(batch)


@examples
@given(st.binary(max_size=200))
def test_any_unit_is_a_frame_or_malformed(unit: bytes) -> None:
    with suppress(DataError):
        parse_unit(unit, 0)


@examples
@given(st.lists(st.tuples(I64, I64, st.integers(0, 10**12)), max_size=12))
def test_any_clock_replies_leave_a_clock_that_can_be_read(replies: list[tuple[int, int, int]]) -> None:
    sync = ClockSync(T0)
    for t2, t3, later in replies:
        request = sync.request(T0)
        sync.receive(ClockReply(request.t1_ns, t2, t3), T0 + later)
        for agent_ns in (-(2**63), 0, 2**63 - 1):
            mapped = sync.to_rig(agent_ns)
            assert mapped is None or mapped[1] >= 0
        assert (sync.estimate is None) == (sync.to_rig(0) is None)
