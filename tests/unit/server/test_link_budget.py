"""The arithmetic of the link, against IEEE 802.3, our own fragmenter and the table of the design."""

import pytest

from rig_protocol.datagram import DEFAULT_DATAGRAM_SIZE
from rig_server.link_budget import (
    AGENT_SPREAD,
    Port,
    backlog_bytes,
    ceiling_fps,
    frame_cost,
    plan_pacing,
    spread_for,
    wire_size,
)

GIGABIT = Port(1000)
BUFFER = 128 * 1024
LOSSLESS = 200_000


def test_gigabit_ethernet_carries_119_6_megabytes_of_udp_payload() -> None:
    assert wire_size(1472) == 1538
    assert GIGABIT.udp_bytes_s == pytest.approx(119.6e6, abs=0.05e6)


def test_jumbo_frames_carry_more_and_a_datagram_never_outgrows_the_protocol() -> None:
    assert Port(1000, 9000).udp_bytes_s == pytest.approx(124.1e6, abs=0.05e6)
    assert Port(1000, 65_535).datagram_size == 65_507
    assert GIGABIT.datagram_size == DEFAULT_DATAGRAM_SIZE


@pytest.mark.parametrize(
    ("payload_bytes", "fps"),
    [(921_600, 10.6), (729_600, 13.4), (220_000, 44.3), (260_000, 37.5), (120_000, 81.2), (140_000, 69.6)],
)
def test_twelve_cameras_reach_the_rates_of_the_design_table(payload_bytes: int, fps: float) -> None:
    assert ceiling_fps(payload_bytes, 12, GIGABIT) == pytest.approx(fps, abs=0.06)


def test_the_papers_frames_fill_the_port_at_6_4_frames_a_second_less_our_headers() -> None:
    """6.4 is with headers of 24 bytes a datagram; ours take 32."""
    assert ceiling_fps(1_536_000, 12, GIGABIT) == pytest.approx(6.35, abs=0.005)


@pytest.mark.parametrize(
    ("payload_bytes", "datagrams", "udp_bytes"),
    [(0, 1, 80), (1392, 1, 1472), (1393, 2, 1505), (1392.5, 2, 1505), (1440 * 99 - 48, 99, 99 * 1472)],
)
def test_a_frame_costs_its_header_its_tag_and_a_header_a_datagram(
    payload_bytes: float, datagrams: int, udp_bytes: int
) -> None:
    cost = frame_cost(payload_bytes)
    assert (cost.datagrams, cost.udp_bytes) == (datagrams, udp_bytes)
    assert cost.wire_bytes == udp_bytes + 66 * datagrams


def lossless_pacing(
    cameras: int = 12, buffer_bytes: int = BUFFER, fps: float = 30.0
) -> tuple[float, int, int]:
    rate = frame_cost(LOSSLESS).datagrams * fps
    pacing = plan_pacing([rate] * cameras, cameras, AGENT_SPREAD, GIGABIT, GIGABIT, buffer_bytes)
    return pacing.step_ns / 1e6, pacing.burst, pacing.backlog_bytes


def test_twelve_lossless_cameras_send_up_to_eight_datagrams_every_one_and_a_half_milliseconds() -> None:
    step_ms, burst, backlog = lossless_pacing(buffer_bytes=256 * 1024)
    assert step_ms == pytest.approx(1.5, abs=0.1)
    assert burst == 8
    assert backlog == 11 * 8 * 1538


@pytest.mark.parametrize("buffer_kib", [128, 150, 256])
def test_bursts_that_all_meet_fit_the_buffer(buffer_kib: int) -> None:
    _, burst, backlog = lossless_pacing(buffer_bytes=buffer_kib * 1024)
    assert 1 <= burst <= 8
    assert backlog <= buffer_kib * 1024


@pytest.mark.parametrize("fps", [0.5, 7.5, 30.0, 60.0])
@pytest.mark.parametrize("cameras", [1, 12, 64])
def test_a_pi_wakes_between_four_hundred_and_a_thousand_times_a_second(cameras: int, fps: float) -> None:
    assert 1.0 <= lossless_pacing(cameras, fps=fps)[0] <= 2.5


def test_a_buffer_that_is_too_small_is_told_by_the_backlog() -> None:
    assert lossless_pacing(buffer_bytes=16 * 1024)[2] > 16 * 1024


def test_slow_agents_cannot_flood_a_fast_port() -> None:
    assert backlog_bytes(8, 10, Port(1000), Port(100)) == 0
    assert backlog_bytes(8, 12, Port(1000), Port(100)) == 2 * 8 * 1538


@pytest.mark.parametrize("share", [0.1, 0.6, 0.78, 0.8, 0.9, 0.95, 0.98])
def test_frames_that_are_sent_all_at_once_do_not_exceed_the_port(share: float) -> None:
    assert AGENT_SPREAD <= spread_for(share) <= 1
    assert share / spread_for(share) <= 1
