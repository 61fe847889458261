"""Whether the server answers: a real handshake with the rig's key, ended at once.

It must not disturb an agent that runs here meanwhile: a hello with that agent's serial number would take
over its session. So while one runs, the hello is anonymous; being refused for that shows that key and
way are right.
"""

import secrets
import select
from dataclasses import replace
from pathlib import Path

from rig_agent.config import AgentSettings
from rig_agent.doctor.finding import Check, Finding, failed, ok, skipped, warning
from rig_agent.doctor.machine import Machine
from rig_agent.hello import make_hello
from rig_agent.sources.base import SourceDescription
from rig_agent.transport import Transport, now_ns
from rig_protocol.agent_link import AgentLink
from rig_protocol.camera import CameraModel
from rig_protocol.errors import ConfigurationError
from rig_protocol.events import Connected, Rejected
from rig_protocol.key_file import KEY_PLACES, rig_key
from rig_protocol.messages import Hello, RejectReason
from rig_protocol.rig_key import RigKey
from rig_protocol.troubleshooting import Topic

_LIMIT_NS = 3_000_000_000  # an agent that seeks its server says hello four times meanwhile
_TURN_NS = 50_000_000
_NO_DEVICE = SourceDescription(None, None, CameraModel(), 30.0, "bayer", "raw")
_OF_ANONYMOUS = {RejectReason.DUPLICATE_SLOT, RejectReason.UNKNOWN_CAMERA}
_MENDS = {
    RejectReason.WRONG_KEY: f"sudo install -m 600 -o kinect-rig rig.key {KEY_PLACES[-1]}",
    RejectReason.VERSION_MISMATCH: "ansible-playbook -i rig.inventory upgrade.yml",
    RejectReason.NO_ROOM: "rig-server budget",
}


def server(machine: Machine, settings: AgentSettings, description: SourceDescription | None) -> list[Finding]:
    """The key, and what the server says to it; `description`: of the source, where it could be opened."""
    try:
        key = rig_key(settings.key_file, settings.insecure)
    except ConfigurationError as error:
        return [failed(Check.KEY, str(error), _key_mend(settings.key_file), Topic.RIG_KEY)]
    if settings.address is None:
        return [_key(settings), skipped(Check.SERVER, "there is no address to ask at")]
    agent_runs = machine.runs("rig-agent")
    known = description or _NO_DEVICE
    hello = make_hello(settings, replace(known, serial=None, port_path=None) if agent_runs else known)
    answer = _meet(settings, key, hello)
    if isinstance(answer, Rejected):
        answer = _refused(settings, answer, agent_runs)
    return [_key(settings), answer]


def _meet(settings: AgentSettings, key: RigKey, hello: Hello) -> Finding | Rejected:
    """Say hello until the server answers, and goodbye at once."""
    transport = Transport(settings.address)
    link = AgentLink(hello, key, secrets.token_bytes, settings.datagram_size)
    try:
        if not transport.open():
            text = f"no way leads to {settings.server}"
            return failed(Check.SERVER, text, "ip route; ip -brief address", Topic.NO_NETWORK)
        answer = _await_answer(transport, link, settings)
        link.close(now_ns())
        for datagram in link.datagrams_to_send(now_ns()):
            transport.send_datagram(datagram)
        return answer
    finally:
        transport.close()


def _await_answer(transport: Transport, link: AgentLink, settings: AgentSettings) -> Finding | Rejected:
    end_ns = now_ns() + _LIMIT_NS
    while (time_ns := now_ns()) < end_ns:
        for datagram in link.datagrams_to_send(time_ns):
            transport.send_datagram(datagram)
        descriptors = [fd for fd in (transport.fileno(),) if fd is not None]
        select.select(descriptors, [], [], _TURN_NS / 1e9)
        for datagram in transport.receive():
            link.receive_datagram(datagram, now_ns())
        match link.next_event():
            case Connected(welcome):
                return ok(Check.SERVER, f"{settings.server} welcomes this camera as {welcome.camera_id}")
            case Rejected() as refusal:
                return refusal
    return _silent(settings, transport)


def _refused(settings: AgentSettings, refusal: Rejected, agent_runs: bool) -> Finding:
    if agent_runs and refusal.reason in _OF_ANONYMOUS:
        return ok(Check.SERVER, f"{settings.server} answers; the place is for the rig-agent that runs here")
    text = f"{settings.server} refuses ({refusal.reason.name}): {refusal.text}"
    mend = _MENDS.get(refusal.reason, "journalctl -u rig-server | grep refused")
    return failed(Check.SERVER, text, mend, Topic.AGENT_REFUSED)


def _silent(settings: AgentSettings, transport: Transport) -> Finding:
    if transport.counters.refused:
        text = f"nobody listens at {settings.server}: its machine is there, rig-server does not run"
        return failed(Check.SERVER, text, "sudo systemctl start rig-server", Topic.SERVER_SILENT)
    host, port = settings.address or (settings.server, 0)
    return failed(
        Check.SERVER,
        f"{settings.server} is silent: off, another address, or UDP port {port} closed by a firewall",
        f"ping -c 3 {host}",
        Topic.SERVER_SILENT,
    )


def _key(settings: AgentSettings) -> Finding:
    if settings.insecure:
        text = "none is used (`insecure`): anybody on this network can watch and join"
        return warning(Check.KEY, text, "rig-server keygen", Topic.RIG_KEY)
    return ok(Check.KEY, "the rig's key can be read, by this user alone")


def _key_mend(file: Path | None) -> str:
    place = file or next((one for one in KEY_PLACES if one.parent != Path() and one.parent.exists()), None)
    return f"sudo install -m 600 -o kinect-rig rig.key {place or KEY_PLACES[-1]}"
