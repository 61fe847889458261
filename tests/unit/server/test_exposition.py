"""What Prometheus is told is what the status says, under names and units that it expects."""

from dataclasses import fields, replace

import pytest
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import Metric
from prometheus_client.openmetrics.exposition import generate_latest as generate_openmetrics
from prometheus_client.openmetrics.parser import text_string_to_metric_families as parse_strictly

from rig_protocol.counters import CameraCounters
from rig_server.exposition import LOST_CAUSES, RigCollector, families
from rig_server.metrics import RigStatus
from support.full_status import full_camera, full_status

Samples = dict[tuple[str, tuple[tuple[str, str], ...]], float]


def samples(metrics: list[Metric]) -> Samples:
    return {(s.name, tuple(sorted(s.labels.items()))): s.value for m in metrics for s in m.samples}


@pytest.fixture
def told() -> Samples:
    return samples(list(families(full_status())))


def test_every_counter_of_a_camera_is_told_exactly_once() -> None:
    camera = full_camera()
    told = samples(list(families(RigStatus((camera,)))))
    for name, count in camera.counters.items():
        assert list(told.values()).count(count) >= 1, name
    by_camera = [key for key in told if key[0].endswith("_total") and ("camera", "cam00") in key[1]]
    assert len(by_camera) == len(fields(CameraCounters)) + len(camera.dropped)


def test_a_counter_that_nobody_gave_a_name_is_told_all_the_same() -> None:
    camera = replace(full_camera(), counters={"invented_later": 5})
    told = samples(list(families(RigStatus((camera,)))))
    assert told["rig_camera_events_total", (("camera", "cam00"), ("event", "invented_later"))] == 5


def test_the_causes_of_loss_are_those_that_the_protocol_adds_up() -> None:
    for field in fields(CameraCounters):
        assert CameraCounters(**{field.name: 1}).lost == (field.name in LOST_CAUSES), field.name


def test_the_sum_of_lost_frames_by_cause_is_the_cameras_loss(told: Samples) -> None:
    lost = sum(
        value
        for (name, labels), value in told.items()
        if name == "rig_frames_lost_total" and ("camera", "cam00") in labels
    )
    assert lost == full_camera().lost


def test_values_are_in_base_units(told: Samples) -> None:
    cam00 = (("camera", "cam00"),)
    assert told["rig_clock_offset_seconds", cam00] == -0.005
    assert told["rig_clock_drift_ratio", cam00] == -12.5e-6
    assert told["rig_clock_uncertainty_seconds", cam00] == 45e-6
    assert told["rig_clock_round_trip_seconds", cam00] == 310e-6
    assert told["rig_agent_temperature_celsius", cam00] == 61.5
    assert told["rig_receive_buffer_bytes", ()] == 4096
    assert told["rig_set_spread_seconds_sum", ()] == 0.025
    assert told["rig_set_uncertainty_seconds_sum", ()] == 80e-6
    arrival = (("stage", "exposure_to_received"),)
    assert told["rig_stage_latency_seconds_sum", arrival] == 0.03


def test_the_rigs_own_counts_are_told_by_cause(told: Samples) -> None:
    assert told["rig_sets_total", (("outcome", "complete"),)] == 901
    assert told["rig_sets_total", (("outcome", "partial"),)] == 17
    assert told["rig_sets_incomplete_total", ()] == 21
    assert told["rig_sets_not_taken_total", ()] == 22
    assert told["rig_frames_left_out_total", ()] == 23
    assert told["rig_frames_implausible_total", ()] == 24
    assert told["rig_kernel_dropped_datagrams_total", ()] == 25
    assert told["rig_unsent_datagrams_total", ()] == 26
    assert told["rig_frames_repeated_total", ()] == 27
    assert told["rig_datagrams_rejected_total", (("cause", "bad_magic"),)] == 31
    assert told["rig_queue_length", (("queue", "decoder"),)] == 3
    assert told["rig_frames_dropped_total", (("camera", "cam00"), ("cause", "late"))] == 7
    assert told["rig_camera_connected", (("camera", "cam01"),)] == 0


def test_buckets_count_up_to_their_bound_and_the_last_one_everything(told: Samples) -> None:
    def bucket(bound: str) -> float:
        return told["rig_stage_latency_seconds_bucket", (("le", bound), ("stage", "received_to_delivered"))]

    assert (bucket("0.0075"), bucket("0.01"), bucket("0.02"), bucket("+Inf")) == (0, 1, 1, 1)


def test_an_agents_gauges_get_fit_names_and_a_bound() -> None:
    many = {f"gauge {i}\x00\u2028": float(i) for i in range(1000)}
    told = samples(list(families(RigStatus((replace(full_camera(), gauges=many),)))))
    names = [dict(labels)["gauge"] for name, labels in told if name == "rig_agent_gauge"]
    assert len(names) == 32
    assert all(name.replace("_", "a").isalnum() and name.isascii() for name in names)


def test_the_same_metrics_exist_whatever_the_status_holds() -> None:
    def names(status: RigStatus) -> list[str]:
        return [metric.name for metric in families(status)]

    assert names(RigStatus(())) == names(full_status())
    assert len(set(names(RigStatus(())))) == len(names(RigStatus(())))


def test_the_text_satisfies_the_strict_parser_and_every_metric_explains_itself() -> None:
    registry = CollectorRegistry()
    registry.register(RigCollector(full_status))
    parsed = list(parse_strictly(generate_openmetrics(registry).decode()))
    assert samples(parsed) == samples(list(families(full_status())))
    assert all(metric.documentation.endswith(".") for metric in parsed)
    assert generate_latest(registry)


def test_a_moved_camera_is_an_alarm_with_its_size(told: Samples) -> None:
    assert told["rig_camera_moved", (("camera", "cam00"),)] == 0
    assert told["rig_camera_moved", (("camera", "cam01"),)] == 1
    assert told["rig_camera_shift_mm", (("camera", "cam01"),)] == 6.25
    assert told["rig_camera_shift_deg", (("camera", "cam01"),)] == 0.52
    assert told["rig_camera_watched", (("camera", "cam00"),)] == 1
    assert told["rig_overlap_residual_mm", (("camera", "cam00"), ("other", "cam01"))] == 7.5
    assert told["rig_drift_looks_total", (("outcome", "looked"),)] == 61
    assert told["rig_drift_looks_total", (("outcome", "busy"),)] == 41
