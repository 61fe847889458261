"""Rules of the agent's settings: where they come from, what a mistake is told, what init writes."""

import re
from pathlib import Path

import pytest

from rig_agent.config import AgentSettings, FolderSettings, load_agent_settings
from rig_agent.simulator.settings import SimulatorSettings
from rig_protocol.errors import ConfigurationError
from rig_protocol.settings_docs import commented_toml, effective_toml


@pytest.fixture(autouse=True)
def _nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No settings of this machine or of the caller's folder take part."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("rig_agent.config.CONFIG_PLACES", (Path("agent.toml"), tmp_path / "etc/agent.toml"))


def load(toml: str) -> AgentSettings:
    Path("given.toml").write_text(toml)
    return load_agent_settings(Path("given.toml"))


def test_without_any_file_the_defaults_hold() -> None:
    assert load_agent_settings(None) == AgentSettings()


def test_the_file_in_this_folder_wins_over_the_machines() -> None:
    Path("etc").mkdir()
    Path("etc/agent.toml").write_text('server = "machine"\n')
    assert load_agent_settings(None).server == "machine"
    Path("agent.toml").write_text('server = "here"\n')
    assert load_agent_settings(None).server == "here"


def test_a_file_that_was_asked_for_must_exist() -> None:
    with pytest.raises(ConfigurationError, match=r"other.toml cannot be read"):
        load_agent_settings(Path("other.toml"))


@pytest.mark.parametrize(
    ("toml", "message"),
    [
        ('sever = "pc"', r"unknown key `sever`; did you mean `server`\?"),
        ("[folder]\npaht = 1", r"unknown key `folder.paht`; did you mean `path`\?"),
        ("[synthetic]\nsead = 1", r"unknown key `synthetic.sead`; did you mean `seed`\?"),
        ("seed = 1", r"unknown key `seed`; did you mean `synthetic.seed`\?"),
        ("[frenect]\nserial = 'x'", r"unknown key `frenect`; did you mean `freenect`\?"),
        (
            'source = "kinect"',
            r"`source`: Input should be 'freenect', 'openni2', .*'recording' or 'synthetic' \(got 'kinect'\)",
        ),
        ('server = "pc:http"', r"`server`: .*'pc:http' is not HOST or HOST:PORT"),
        ('server = ":4012"', r"`server`: .*is not HOST or HOST:PORT"),
        ("camera = -1", r"`camera`: .*greater than or equal to 0 \(got -1\)"),
        ("datagram_size = 100", r"`datagram_size`: .*1200 \(got 100\)"),
        ('name = "two words"', r"`name`: .*pattern"),
        ("fps = 0", r"`fps`: .*greater than or equal to 0.1"),
    ],
)
def test_a_mistake_is_named_with_the_nearest_key(toml: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        load(toml)


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("pc", ("pc", 4012)),
        ("10.0.0.1:99", ("10.0.0.1", 99)),
        ("[fe80::1]:99", ("fe80::1", 99)),
        ("[::1]", ("::1", 4012)),
    ],
)
def test_the_server_is_a_host_with_or_without_port(text: str, address: tuple[str, int]) -> None:
    assert AgentSettings(server=text).address == address


def test_the_name_follows_from_the_slot_unless_it_is_given() -> None:
    assert AgentSettings().display_name(3) == "cam03"
    assert AgentSettings(name="door").display_name(3) == "door"
    assert AgentSettings().display_name(None)


def test_the_effective_settings_load_into_the_same() -> None:
    settings = AgentSettings(
        server="pc:1",
        source="folder",
        camera=3,
        folder=FolderSettings(path=Path("a folder/ä"), camera="left"),
        synthetic=SimulatorSettings(seed=4, room_m=(4.0, 5.5, 2.5)),
    )
    assert load(effective_toml(settings)) == settings
    assert load(effective_toml(AgentSettings())) == AgentSettings()


def test_the_file_that_init_writes_changes_nothing() -> None:
    assert load(commented_toml(AgentSettings)) == AgentSettings()


def test_every_line_that_init_writes_is_valid_when_uncommented() -> None:
    settings = load(re.sub(r"^#(?! )", "", commented_toml(AgentSettings), flags=re.MULTILINE))
    assert settings.camera == 0
    assert settings.folder.camera == "cam00"
