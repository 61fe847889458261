"""What every export of frames owes: no half output, nothing overwritten, words for what is left out."""

import pickle
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import pytest

from rig_calib.frame_exports.formats import FORMATS
from rig_calib.frame_exports.job import Exported, ExportJob
from rig_calib.offline.workers import Batch, Tell
from rig_calib.rig_calibration import RigCalibration
from rig_calib.whole_folder import refuse_existing
from rig_protocol.errors import ConfigurationError, DataError, RigError
from rig_protocol.frames import PanoramicFrame
from rig_protocol.recording import recover
from support.box_room import calibration_of
from support.box_takes import (
    POSES,
    box_calibration,
    box_description,
    box_panorama,
    damaged,
    export_job,
    write_take,
)

Result = TypeVar("Result")
OURS = ["foxglove", "rerun", "tum", "rig-folder"]
NEEDING_CALIBRATION = ["foxglove", "rerun", "tum"]
FRAMES = 5


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five sets that carry no calibration: in set 1 a camera is missing, in set 2 a frame is damaged."""
    sets = {k: dict(box_panorama(k).frames) for k in range(FRAMES)}
    sets[1][1] = None
    sets[2][2] = damaged(sets[2][2])  # type: ignore[arg-type]
    panoramas = [PanoramicFrame.of(k, frames) for k, frames in sets.items()]
    return write_take(tmp_path_factory.mktemp("take") / "take.mcap", box_description(), panoramas)


class OtherProcesses:
    """Whoever works elsewhere: work and results cross a border, and what stands is looked at meanwhile."""

    def __init__(self, look: Callable[[], None], fail: bool = False) -> None:
        self._look, self._fail = look, fail

    def map(
        self, work: Callable[[Batch], Result], batches: Sequence[Batch], tell: Tell | None = None
    ) -> Iterator[Result]:
        del tell
        for batch in batches:
            far_work, far_batch = pickle.loads(pickle.dumps((work, batch)))  # noqa: S301
            result: Result = pickle.loads(pickle.dumps(far_work(far_batch)))  # noqa: S301
            yield result
            self._look()
            if self._fail:
                raise RigError("a worker was lost")


def job_of(take: Path, form: str, folder: Path, calibration: RigCalibration | None = None) -> ExportJob:
    out = folder / f"out{FORMATS[form].suffix or ''}"
    return export_job(take, out, calibration or box_calibration())


def export(form: str, job: ExportJob) -> Exported:
    return FORMATS[form].exporter()(job)


@pytest.mark.parametrize("form", OURS)
def test_nothing_stands_under_the_name_before_all_of_it_does(form: str, take: Path, tmp_path: Path) -> None:
    job = job_of(take, form, tmp_path)
    looks: list[bool] = []
    exported = export(form, replace(job, workers=OtherProcesses(lambda: looks.append(job.out.exists()))))
    assert exported.paths == (job.out,)
    assert len(looks) > 1
    assert not any(looks)
    assert [path.name for path in tmp_path.iterdir()] == [job.out.name]


@pytest.mark.parametrize("form", OURS)
def test_what_fails_half_way_leaves_nothing(form: str, take: Path, tmp_path: Path) -> None:
    job = job_of(take, form, tmp_path)
    with pytest.raises(RigError, match="a worker was lost"):
        export(form, replace(job, workers=OtherProcesses(lambda: None, fail=True)))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("form", OURS)
def test_what_exists_is_never_overwritten(form: str, take: Path, tmp_path: Path) -> None:
    job = job_of(take, form, tmp_path)
    kept = job.out if FORMATS[form].suffix else job.out / "notes.txt"
    kept.parent.mkdir(exist_ok=True)
    kept.write_text("mine")
    with pytest.raises(ConfigurationError, match="exists and stays as it is"):
        export(form, job)
    assert kept.read_text() == "mine"


@pytest.mark.parametrize("form", NEEDING_CALIBRATION)
def test_a_missing_calibration_is_told_with_the_way_out(form: str, take: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"carries no calibration.*--calibration FILE"):
        export(form, replace(job_of(take, form, tmp_path), calibration=None))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("form", NEEDING_CALIBRATION)
def test_a_calibration_of_another_rig_is_told(form: str, take: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="places no camera"):
        export(form, job_of(take, form, tmp_path, calibration_of({7: POSES[0]})))


@pytest.mark.parametrize("form", NEEDING_CALIBRATION)
def test_cameras_without_a_place_are_left_out_with_a_word(form: str, take: Path, tmp_path: Path) -> None:
    known = calibration_of({0: POSES[0], 1: POSES[1]})
    notes = export(form, job_of(take, form, tmp_path, known)).notes
    assert "cam02: left out, the calibration could not place it" in notes


@pytest.mark.parametrize("form", OURS)
def test_missing_and_damaged_frames_are_left_out_and_counted(form: str, take: Path, tmp_path: Path) -> None:
    notes = export(form, job_of(take, form, tmp_path)).notes
    assert [note for note in notes if "missing or damaged" in note] == [
        "cam01: 1 of 5 frames are missing or damaged, and left out",
        "cam02: 1 of 5 frames are missing or damaged, and left out",
    ]


@pytest.mark.parametrize("form", FORMATS)
def test_where_no_image_can_be_read_nothing_is_written_and_that_is_told(form: str, tmp_path: Path) -> None:
    source = write_take(tmp_path / "take.mcap", box_description(), [box_panorama(0)], broken={0})
    with pytest.raises(DataError, match=r"none of the 1 panoramic frames .* holds an image"):
        export(form, job_of(source, form, tmp_path))
    assert list(tmp_path.iterdir()) == [source]


@pytest.mark.parametrize("out", [Path(), Path("/")])
def test_a_place_without_a_name_is_refused(out: Path) -> None:
    with pytest.raises(ConfigurationError, match="has no name"):
        refuse_existing(out)


def test_a_take_without_a_date_is_stamped_in_rig_time_and_says_so(tmp_path: Path) -> None:
    take = write_take(tmp_path / "take.mcap", box_description(), [box_panorama(0)], created="")
    exported = export("tum", job_of(take, "tum", tmp_path))
    assert exported.notes == (f"time stamps are rig time: {take} does not tell its date",)
    assert (tmp_path / "out/cam01/rgb/5.001000.png").is_file()


def test_a_recovered_take_still_tells_its_date(take: Path, tmp_path: Path) -> None:
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(take.read_bytes()[:-200])
    assert recover(torn) == [torn]
    job = job_of(torn, "tum", tmp_path)
    assert not any("rig time" in note for note in export("tum", job).notes)
