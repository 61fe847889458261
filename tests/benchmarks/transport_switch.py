"""Section `switch`: twelve hosts, a switch with a small buffer, a PC behind one gigabit port of it.

python tests/benchmarks/transport_switch.py       (root; iproute2, nftables, ethtool)

All thirteen machines share this one's processors. Where these are too slow for them or busy with other
programs, the load is repeated in slow motion: frame rates and the port's rate divided by the same factor,
the buffer as it was. What the network does to datagrams is the same then; `slow_motion` says the factor.
The server checks and reassembles every frame and does not decode it.
"""

import json
import logging
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from support.network_namespaces import why_unavailable
from support.preencoded_sender import encoded_file
from support.switch_load import Load, Outcome, run_load
from support.virtual_network import payload_ceiling

BUFFER_KIB = 128
SLOW_MOTION = (1, 2, 4)
SECONDS = 14.0
# Every camera exposes at the same instant: the worst case, which free-running Kinects come to now and then.
IN_PHASE = Load(30.0, SECONDS, phase="same", buffer_kib=BUFFER_KIB)
FREE = replace(IN_PHASE, phase="free")
UNPACED = replace(IN_PHASE, paced=False)
# 24-bit colour and 16-bit depth, uncompressed: 6.4 frames a second is what fits through the port.
RAW_FRAME_BYTES = 640 * 480 * (3 + 2)
RAW_CEILING_FPS = 6.4
RAW = Load(6.25, SECONDS, buffer_kib=BUFFER_KIB)


def run() -> dict[str, Any]:
    """The section `switch` of bench.json."""
    reason = why_unavailable()
    if reason is not None:
        return {"skipped": reason}
    with encoded_file("lossless") as (file, frames):
        cases = {
            "paced, in phase": undisturbed(IN_PHASE, file),
            "paced, phases of their own": undisturbed(FREE, file),
            "unpaced, in phase": undisturbed(UNPACED, file),
        }
        facts = {"frames": frames.origin, "frame_kib": frames.frame_bytes / 1024}
    with encoded_file("rgb24") as (file, _):
        cases["RGB24 and 16-bit depth"] = raw = undisturbed(RAW, file)
    return {
        "paced_lost_sets": cases["paced, in phase"]["lost_sets"],
        "unpaced_lost_sets": cases["unpaced, in phase"]["lost_sets"],
        "paced_port_dropped": cases["paced, in phase"]["port_dropped"],
        "unpaced_port_dropped": cases["unpaced, in phase"]["port_dropped"],
        "raw_ceiling_ratio": raw["delivered_fps"] / RAW_CEILING_FPS,
        "raw_payload_ratio": raw["delivered_fps"] * 12 * RAW_FRAME_BYTES / payload_ceiling(1000),
        "raw_wire_ratio": raw["port_load"],
        "hosts": IN_PHASE.cameras,
        "buffer_kib": BUFFER_KIB,
        **facts,
        "cases": cases,
    }


def undisturbed(load: Load, frames: Path) -> dict[str, Any]:
    """Figures of the load at the least slow motion that nothing but the network decides."""
    for factor in SLOW_MOTION:
        longer = replace(load, seconds=load.seconds * (1 + factor) / 2)
        outcome = run_load(longer.slower(factor), frames)
        if not outcome.disturbed:
            break
    return figures(outcome, factor)


def figures(outcome: Outcome, factor: int) -> dict[str, Any]:
    """What bench.json keeps of an outcome; the rate as if at full speed."""
    port = outcome.port
    return {
        "lost_sets": outcome.lost_sets,
        "complete_sets": outcome.complete_sets,
        "delivered_fps": outcome.delivered_fps * factor,
        "frames": outcome.frames,
        "lost_frames": outcome.lost_frames,
        "resent_datagrams": outcome.resent,
        "slow_motion": factor,
        "real_time": outcome.real_time,
        "disturbed": outcome.disturbed,
        "port_load": outcome.port_load,
        "port_dropped": port.dropped / max(port.dropped + port.datagrams, 1),
        "sender_dropped_frames": outcome.sender_dropped,
        "sender_cores": outcome.sender_cores,
        "server_cores": outcome.server_cores,
        "others_cores": outcome.others_cores,
        "server_dropped": {cause: count for cause, count in outcome.dropped.items() if count},
    }


def main() -> None:
    """Print the section."""
    logging.basicConfig(level=logging.ERROR)  # that cameras join and leave is no news here
    print(json.dumps(run(), indent=1))


if __name__ == "__main__":
    main()
