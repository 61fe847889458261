"""Rules of the pages that are made by the program."""

import importlib.util
import re
from pathlib import Path
from types import ModuleType

from rig_server.exposition import families
from support.full_status import full_status

DOCS = Path(__file__).resolve().parents[2] / "docs"


def generator(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_configuration_page_is_what_the_settings_say() -> None:
    page = (DOCS / "configuration.md").read_text()
    assert page == generator("generate_configuration").page(), "run `make docs`"


def test_the_monitoring_page_lists_the_metrics_that_there_are() -> None:
    page = (DOCS / "monitoring.md").read_text()
    assert page == generator("generate_monitoring").page(page), "run `make docs`"


def test_the_monitoring_page_speaks_of_no_metric_that_there_is_not() -> None:
    told = {sample.name for metric in families(full_status()) for sample in metric.samples}
    told |= {metric.name for metric in families(full_status())}
    named = set(re.findall(r"\brig_[a-z_]+[a-z]\b(?!/)", (DOCS / "monitoring.md").read_text()))
    assert named - told <= {"rig_camera_events_total"}  # the metric of counters without a name has no sample
