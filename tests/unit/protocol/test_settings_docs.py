"""Rules of generated documentation: it comes from the model alone, and it loads."""

import re
import tomllib
from pathlib import Path
from typing import Literal

from pydantic import Field

from rig_protocol.settings import Settings, load_settings
from rig_protocol.settings_docs import commented_toml, effective_toml, markdown_table


class Camera(Settings):
    """One camera of the ring."""

    id: int = Field(0, ge=0)
    """Slot of the camera."""
    serial: str | None = Field(None, examples=["A00362A12345045A"])
    """Serial number."""


class Depth(Settings):
    codec: Literal["lossless", "raw"] = "lossless"
    """How depth travels."""


class Program(Settings):
    """Settings of a program."""

    depth: Depth = Depth(codec="raw")
    """The depth stream."""
    cameras: tuple[Camera, ...] = ()
    """The ring, one table a camera."""
    server: str = "localhost:4012"
    """Where the server listens:
    a name or an address."""
    fps: float = Field(30.0, gt=0, le=60)
    """Frames a second."""
    out: Path = Path("out")
    """Folder of the results."""
    limits: tuple[float, ...] = (0.5, float("inf"))
    """Bounds."""


def load(tmp_path: Path, toml: str) -> Program:
    file = tmp_path / "program.toml"
    file.write_text(toml)
    return load_settings(Program, file, "RIG_TEST_")


def test_the_commented_file_changes_nothing(tmp_path: Path) -> None:
    assert load(tmp_path, commented_toml(Program)) == Program()


def test_the_commented_file_loads_when_every_key_is_uncommented(tmp_path: Path) -> None:
    text = re.sub(r"^#(?! )", "", commented_toml(Program), flags=re.MULTILINE)
    assert load(tmp_path, text) == Program(cameras=(Camera(serial="A00362A12345045A"),))


def test_the_commented_file_explains_every_key() -> None:
    text = commented_toml(Program)
    assert text.startswith("# Settings of a program.\n")
    assert "# Where the server listens:\n# a name or an address.\n#server = " in text
    assert "# Unset by default (text). For example:\n#serial = " in text


def test_a_tables_own_default_wins_over_its_models() -> None:
    assert '\ncodec = "raw"' in commented_toml(Program)
    assert '`depth.codec` | "lossless" \\| "raw" | `"raw"`' in markdown_table(Program)


def test_effective_values_load_into_an_equal_object(tmp_path: Path) -> None:
    settings = Program(
        server='a "quoted" \\ \n name',
        cameras=(Camera(id=3), Camera(id=4, serial="x")),
        limits=(1.0, float("-inf")),
        depth=Depth(codec="lossless"),
    )
    assert load(tmp_path, effective_toml(settings)) == settings


def test_an_empty_list_of_tables_stays_empty() -> None:
    assert tomllib.loads(effective_toml(Program()))["cameras"] == []


def test_the_markdown_table_has_one_row_a_key_with_bounds_and_default() -> None:
    table = markdown_table(Program)
    assert "| `fps` | number, > 0, ≤ 60 | `30.0` | Frames a second. |" in table
    assert "| `cameras[].serial` | text | unset | Serial number. |" in table
    assert len(table.splitlines()) == 2 + 7
