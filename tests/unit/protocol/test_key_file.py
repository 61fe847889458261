"""The key file: who may read it, what is said when somebody else may, and how it is written."""

import logging
import os
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest

from rig_protocol import key_file
from rig_protocol.errors import ConfigurationError
from rig_protocol.key_file import read_key, rig_key, write_key
from rig_protocol.rig_key import RigKey
from support.wire import KEY

OTHER_KEY = RigKey(bytes(32))


@pytest.fixture
def written(tmp_path: Path) -> Path:
    write_key(path := tmp_path / "rig.key", KEY)
    return path


@pytest.fixture
def _no_umask() -> Iterator[None]:
    before = os.umask(0)
    yield
    os.umask(before)


def mode_of(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


# ---- reading


def test_a_key_is_read_as_it_was_written(written: Path) -> None:
    assert read_key(written) == KEY


@pytest.mark.parametrize("mode", [0o600, 0o400])
def test_a_file_for_its_owner_alone_is_read(written: Path, mode: int) -> None:
    written.chmod(mode)
    assert read_key(written) == KEY


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660, 0o620, 0o602, 0o644, 0o666, 0o601, 0o700])
def test_a_file_that_others_may_use_is_refused_with_the_command_to_run(written: Path, mode: int) -> None:
    written.chmod(mode)
    with pytest.raises(ConfigurationError) as caught:
        read_key(written)
    assert f"mode {mode:04o}" in str(caught.value)
    assert f"chmod 600 {written}" in str(caught.value)
    assert "rig-server keygen --force" in str(caught.value)


def test_a_file_without_a_key_is_named(tmp_path: Path) -> None:
    contents = {"empty": b"", "text": b"hello", "binary": bytes(range(256)), "huge": b"x" * 10_000_000}
    for name, content in contents.items():
        path = tmp_path / name
        path.touch(0o600)
        path.write_bytes(content)
        with pytest.raises(ConfigurationError, match=name):
            read_key(path)


def test_a_damaged_key_is_told_to_be_copied_again(written: Path) -> None:
    written.write_text(written.read_text()[:-9])
    with pytest.raises(ConfigurationError, match="copy the file again from the server"):
        read_key(written)


def test_an_absent_file_and_a_folder_are_told_apart(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"absent.key cannot be read: No such file"):
        read_key(tmp_path / "absent.key")
    with pytest.raises(ConfigurationError, match="cannot be read: Is a directory"):
        read_key(tmp_path)


# ---- choosing


def test_the_file_that_was_named_is_used(written: Path) -> None:
    assert rig_key(written, insecure=False) == KEY


def test_else_the_first_place_that_has_one(
    written: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    places = (tmp_path / "here.key", written)
    monkeypatch.setattr(key_file, "KEY_PLACES", places)
    assert rig_key(None, insecure=False) == KEY
    write_key(places[0], OTHER_KEY)
    assert rig_key(None, insecure=False) == OTHER_KEY


def test_a_named_file_that_is_absent_is_not_replaced_by_another_place(
    written: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(key_file, "KEY_PLACES", (written,))
    with pytest.raises(ConfigurationError, match=r"mine\.key cannot be read"):
        rig_key(tmp_path / "mine.key", insecure=False)


def test_without_any_key_the_operator_is_told_how_to_make_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(key_file, "KEY_PLACES", (tmp_path / "rig.key",))
    with pytest.raises(ConfigurationError, match=r"`rig-server keygen`.*--insecure on an isolated bench"):
        rig_key(None, insecure=False)


def test_insecure_uses_the_public_key_and_warns_even_where_a_key_lies_about(
    written: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(key_file, "KEY_PLACES", (written,))
    with caplog.at_level(logging.WARNING):
        assert rig_key(None, insecure=True).is_public
    assert "INSECURE: anybody on this network can watch, join and forge" in caplog.text


def test_insecure_and_a_named_key_exclude_each_other(written: Path) -> None:
    with pytest.raises(ConfigurationError, match="exclude each other"):
        rig_key(written, insecure=True)


# ---- writing


@pytest.mark.usefixtures("_no_umask")
def test_a_key_is_for_its_owner_alone_from_the_first_byte_whatever_the_umask(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    modes: list[int] = []
    monkeypatch.setattr(RigKey, "to_text", lambda _key: modes.extend(map(mode_of, tmp_path.iterdir())) or "x")
    write_key(tmp_path / "rig.key", KEY)
    assert modes == [0o600]  # of the one file that was there before a byte of it was made
    assert mode_of(tmp_path / "rig.key") == 0o600


def test_an_existing_key_is_replaced_only_by_force_and_then_for_its_owner_alone(written: Path) -> None:
    written.chmod(0o644)
    with pytest.raises(ConfigurationError, match=r"rig\.key exists: a new key locks out .*--force"):
        write_key(written, OTHER_KEY)
    write_key(written, OTHER_KEY, force=True)
    assert (read_key(written), mode_of(written)) == (OTHER_KEY, 0o600)


def test_a_key_that_cannot_be_written_whole_leaves_the_old_one_and_nothing_else(
    written: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full_disk(_descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("rig_protocol.key_file.os.fsync", full_disk)
    with pytest.raises(ConfigurationError, match="cannot be written: No space left"):
        write_key(written, OTHER_KEY, force=True)
    assert read_key(written) == KEY
    assert list(written.parent.iterdir()) == [written]


@pytest.mark.parametrize("place", ["absent/rig.key", "file/rig.key", "/proc/rig.key"])
def test_a_place_that_cannot_be_written_is_told_in_one_sentence(tmp_path: Path, place: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigurationError, match=r"rig\.key cannot be written"):
        write_key(tmp_path / place, KEY)
