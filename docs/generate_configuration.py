"""Write docs/configuration.md from the settings models: `make docs`."""

from pathlib import Path

from rig_agent.config import AgentSettings
from rig_protocol.settings_docs import markdown_table
from rig_server.config import RigSettings

PAGE = Path(__file__).parent / "configuration.md"

_TEMPLATE = """# Configuration

Made by `make docs` from the settings models; do not edit.

Every setting can stand in the file or in the environment, some also on the command line. The command line
wins over the environment, the environment over the file, the file over the default. Unknown keys are refused
with the nearest known name. In the environment, a key of a table is joined by two underscores:
`RIG_AGENT_FREENECT__SERIAL`.

## agent.toml

Searched at `--config`, else `./agent.toml`, else `/etc/kinect-rig/agent.toml`. Environment: `RIG_AGENT_*`.
`rig-agent init` writes a commented one, `rig-agent --print-config` shows what is in effect.

{agent}

## rig.toml

Searched at `--config`, else `./rig.toml`, else `/etc/kinect-rig/rig.toml`. Environment: `RIG_SERVER_*`.
`rig-server init` writes a commented one. The effective settings are saved with every calibration.

{server}
"""


def page() -> str:
    """The whole page."""
    tables = {"agent": markdown_table(AgentSettings), "server": markdown_table(RigSettings)}
    return _TEMPLATE.format(**{name: table.rstrip() for name, table in tables.items()})


if __name__ == "__main__":
    PAGE.write_text(page())
