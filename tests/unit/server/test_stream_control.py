"""Between link and planner: what agents are told, who is sent away."""

from dataclasses import replace

from rig_protocol.events import CameraJoined, CameraLeft
from rig_protocol.messages import ClockReply, ClockRequest, Goodbye, Heartbeat, StreamPlan
from rig_protocol.server_link import ServerLink
from rig_server.config import LinkSettings
from rig_server.stream_control import StreamControl
from rig_server.stream_planner import StreamPlanner
from support.peers import AgentPeer
from support.planned_rig import DEPTH, JPEG, KINECT, LOSSLESS, UNCOMPRESSED
from support.wire import AGENT, OTHER, SECOND_NS, T0, events_of, make_server

COLORS = (LOSSLESS, UNCOMPRESSED, JPEG)


def control(**link: object) -> tuple[ServerLink, StreamControl]:
    planner = StreamPlanner(LinkSettings.model_validate(link))
    server = make_server(color_codecs=COLORS, depth_codecs=(DEPTH,), objection=planner.objection)
    return server, StreamControl(server, planner)


def join(server: ServerLink, streams: StreamControl, camera_id: int, address: tuple[str, int]) -> AgentPeer:
    """A camera in session of whose clock the server has a sample."""
    peer = AgentPeer(replace(KINECT, camera_id=camera_id, serial=f"S{camera_id}"), seed=50 + camera_id)
    server.receive_datagram(peer.hello, address, T0)
    [(welcome, _)] = server.datagrams_to_send(T0)
    peer.accept(welcome)
    server.receive_datagram(peer.seal(Heartbeat({})), address, T0)
    for event in events_of(server):
        streams.take(event, T0)
    said = told(server, peer, address, T0)
    for request in said:
        if isinstance(request, ClockRequest):
            server.receive_datagram(peer.seal(ClockReply(request.t1_ns, T0, T0)), address, T0)
    return peer


def told(server: ServerLink, peer: AgentPeer, address: tuple[str, int], now_ns: int) -> list[object]:
    server.handle_timeout(now_ns)
    return peer.read([datagram for datagram, to in server.datagrams_to_send(now_ns) if to == address])


def test_every_camera_is_told_its_slot() -> None:
    server, streams = control()
    peers = [
        (join(server, streams, camera, address), address) for camera, address in enumerate((AGENT, OTHER))
    ]
    server.handle_timeout(T0 + SECOND_NS)
    sent = server.datagrams_to_send(T0 + SECOND_NS)
    said = [peer.read([datagram for datagram, to in sent if to == address]) for peer, address in peers]
    plans = [message for messages in said for message in messages if isinstance(message, StreamPlan)]
    assert [plan.color_codec for plan in plans] == [LOSSLESS, LOSSLESS]
    assert len({plan.phase_ns for plan in plans}) == 2
    assert streams.summary is not None
    assert "everything goes losslessly" in streams.summary


def test_a_camera_for_which_there_is_no_room_any_more_is_sent_away_with_the_reason() -> None:
    """Two hellos came before either began its session: at the door there was room for each."""
    server, streams = control(speed_mbit=100, adapt=False)
    first = join(server, streams, 0, AGENT)
    hello = replace(KINECT, camera_id=1, serial="S1")
    streams.take(CameraJoined(1, hello, OTHER), T0)  # the planner knows it, the link has no such session
    assert told(server, first, AGENT, T0 + SECOND_NS)  # the first goes on
    second = AgentPeer(hello, seed=60)
    server.receive_datagram(second.hello, OTHER, T0)
    assert server.rejected["refused_no_room"] == 1
    server.dismiss(0, "no room")
    assert [type(event) for event in events_of(server)][-1] is CameraLeft
    sent = [datagram for datagram, to in server.datagrams_to_send(T0) if to == AGENT]
    assert Goodbye("no room") in first.read(sent)
