"""rig.toml: what is accepted, what is refused and how it says so."""

from pathlib import Path

import pytest

from rig_protocol.errors import ConfigurationError
from rig_protocol.rig_folder import RingDrawing
from rig_protocol.settings_docs import commented_toml, effective_toml
from rig_server.config import RigSettings, load_rig_settings, parse_address, read_intrinsics

FULL = """
listen = "192.168.7.1:7500"
[ring]
radius_m = 0.3
tolerance_deg = 2.0
[synchroniser]
max_spread_ms = 20
[[cameras]]
id = 0
serial = "A0036"
[[cameras]]
id = 1
name = "north"
port_path = "1-1.2"
intrinsics = "north.json"
"""


@pytest.fixture
def written(tmp_path: Path) -> Path:
    path = tmp_path / "rig.toml"
    path.write_text(FULL)
    return path


def refusal(tmp_path: Path, text: str) -> str:
    path = tmp_path / "rig.toml"
    path.write_text(text)
    with pytest.raises(ConfigurationError) as caught:
        load_rig_settings(path)
    return str(caught.value)


def test_a_full_file_is_read(written: Path) -> None:
    settings = load_rig_settings(written)
    assert settings.address == ("192.168.7.1", 7500)
    assert settings.ring is not None
    assert settings.ring.drawing() == RingDrawing(0.3, 30.0, 2.0, 0.005)
    assert [camera.label for camera in settings.cameras] == ["cam00", "north"]


def test_intrinsics_files_are_found_beside_the_file_that_names_them(written: Path) -> None:
    assert load_rig_settings(written).cameras[1].intrinsics == written.parent / "north.json"


def test_without_a_ring_the_places_are_unknown() -> None:
    assert RigSettings().ring is None


def test_the_command_line_comes_before_the_environment_and_that_before_the_file(
    written: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RIG_SERVER_LISTEN", ":7600")
    monkeypatch.setenv("RIG_SERVER_CAPTURE__FRAMES", "9")
    settings = load_rig_settings(written, {"listen": "127.0.0.1:0", "capture": {"frames": None}})
    assert settings.address == ("127.0.0.1", 0)
    assert settings.capture.frames == 9


def test_rig_toml_of_the_working_directory_is_found(written: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(written.parent)
    assert load_rig_settings(None).address[1] == 7500


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("lisen = ':4012'", "did you mean `listen`"),
        ("[ring]\nradius = 0.2", "did you mean `radius_m`"),
        ("listen = 'somewhere:99999'", "port from 0 to 65535"),
        ("[[cameras]]\nid = 1\n[[cameras]]\nid = 1", "two cameras share id 1"),
        ("[[cameras]]\nid = 0\nname = 'cam01'\n[[cameras]]\nid = 1", "two cameras share name 'cam01'"),
        (
            "[[cameras]]\nid = 0\nserial = 'A'\n[[cameras]]\nid = 1\nserial = 'A'",
            "two cameras share serial 'A'",
        ),
        ("[[cameras]]\nid = 0\nname = '../etc'", "cameras.0.name"),
        ("[[cameras]]\nname = 'cam01'", "cameras.0.id"),
        ("expected_cameras = 3\n[[cameras]]\nid = 0", "expected_cameras is 3, 1 are listed"),
        ("[capture]\nframes = 0", "capture.frames"),
        ("[link]\nusable = 1.5", "link.usable"),
        ("[link]\nspeed = 100", "did you mean `speed_mbit`"),
        ("[synchroniser]\ndeadline_ms = -5", "synchroniser.deadline_ms"),
        ("metrics = ':9100'", "for all interfaces write 0.0.0.0:PORT"),
        ("metrics = 99999", "a port from 0 to 65535"),
        ("listen = ", "is not valid TOML"),
    ],
)
def test_a_wrong_setting_is_refused_by_name(tmp_path: Path, text: str, told: str) -> None:
    assert told in refusal(tmp_path, text)


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("10.0.0.1:7000", ("10.0.0.1", 7000)),
        ("10.0.0.1", ("10.0.0.1", 4012)),
        (":7000", ("0.0.0.0", 7000)),  # noqa: S104  # what an empty host means
        ("[::1]:7000", ("::1", 7000)),
    ],
)
def test_an_address_may_leave_out_host_or_port(text: str, address: tuple[str, int]) -> None:
    assert parse_address(text) == address


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("metrics = 9100", ("127.0.0.1", 9100)),
        ("metrics = '9100'", ("127.0.0.1", 9100)),
        ("metrics = '10.0.0.1:9100'", ("10.0.0.1", 9100)),
        ("metrics = '[::1]:9100'", ("::1", 9100)),
        ("", None),
    ],
)
def test_metrics_are_for_this_machine_unless_a_host_is_named(
    tmp_path: Path, text: str, address: tuple[str, int] | None
) -> None:
    (tmp_path / "rig.toml").write_text(text)
    assert load_rig_settings(tmp_path / "rig.toml").metrics_address == address


def test_the_commented_file_changes_nothing_and_the_effective_one_says_the_same(
    tmp_path: Path, written: Path
) -> None:
    template = tmp_path / "template.toml"
    template.write_text(commented_toml(RigSettings))
    assert load_rig_settings(template) == RigSettings()
    settings = load_rig_settings(written)
    written.write_text(effective_toml(settings))
    assert load_rig_settings(written) == settings


@pytest.mark.parametrize("content", [None, "{", '{"color": {"fx": -1}}'])
def test_an_intrinsics_file_that_cannot_be_used_is_a_configuration_error(
    tmp_path: Path, content: str | None
) -> None:
    path = tmp_path / "cam.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(ConfigurationError, match=r"cam\.json"):
        read_intrinsics(path)
