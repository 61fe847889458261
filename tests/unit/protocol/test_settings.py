"""Rules of settings: where a value may come from, and what a mistake is told."""

from pathlib import Path

import pytest
from pydantic import Field

from rig_protocol.errors import ConfigurationError
from rig_protocol.settings import Settings, load_settings


class Depth(Settings):
    codec: str = "lossless"


class Program(Settings):
    server: str = "localhost:4012"
    fps: float = Field(30.0, gt=0)
    depth: Depth = Depth()


PREFIX = "RIG_TEST_"


def load(tmp_path: Path, toml: str = "", **overrides: object) -> Program:
    file = tmp_path / "program.toml"
    file.write_text(toml)
    return load_settings(Program, file, PREFIX, overrides)


def test_defaults_hold_without_any_source() -> None:
    assert load_settings(Program, None, PREFIX) == Program()


def test_the_command_line_wins_over_environment_over_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    toml = 'server = "file:1"\nfps = 5.0\n[depth]\ncodec = "raw"\n'
    monkeypatch.setenv("RIG_TEST_SERVER", "environment:1")
    monkeypatch.setenv("RIG_TEST_FPS", "15")
    settings = load(tmp_path, toml, server="line:1", fps=None)
    assert settings == Program(server="line:1", fps=15, depth=Depth(codec="raw"))


def test_tables_merge_key_by_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RIG_TEST_DEPTH__CODEC", "raw")
    assert load(tmp_path, "fps = 5.0\n").depth.codec == "raw"


@pytest.mark.parametrize(
    ("toml", "message"),
    [
        ('sever = "a:1"', r"unknown key `sever`; did you mean `server`"),
        ('[depth]\nkodec = "raw"', r"unknown key `depth.kodec`; did you mean `codec`"),
        ('codec = "raw"', r"unknown key `codec`; did you mean `depth.codec`"),
        ("fps = 0", r"`fps`: Input should be greater than 0 \(got 0\)"),
        ('fps = "fast"', r"`fps`: .*number.*\(got 'fast'\)"),
        ("fps = ", r"not valid TOML"),
    ],
)
def test_a_mistake_in_the_file_is_explained(tmp_path: Path, toml: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        load(tmp_path, toml)


def test_an_absent_file_is_a_usage_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="cannot be read"):
        load_settings(Program, tmp_path / "none.toml", PREFIX)


def test_a_misspelt_environment_variable_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RIG_TEST_SEVER", "a:1")
    with pytest.raises(ConfigurationError, match="RIG_TEST_SEVER names no setting; did you mean"):
        load_settings(Program, None, PREFIX)
