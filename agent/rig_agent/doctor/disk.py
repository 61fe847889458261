"""Room for logs and recordings, and whether anything can be written at all."""

from rig_agent.config import AgentSettings
from rig_agent.doctor.finding import Check, Finding, failed, ok, skipped, warning
from rig_agent.doctor.machine import Machine
from rig_protocol.troubleshooting import Topic

_FOLDERS = ("/", "/var/log", "/var/lib/kinect-rig")
_SCARCE_BYTES = 500 << 20
_FULL_BYTES = 20 << 20


def disk(machine: Machine, _settings: AgentSettings) -> list[Finding]:
    """Free space and the root file system's state."""
    return [_space(machine), _writable(machine)]


def _space(machine: Machine) -> Finding:
    present = [folder for folder in _FOLDERS if machine.path(folder).is_dir()]
    free = {folder: machine.free_bytes(machine.path(folder)) for folder in present}
    folder = min(free, key=lambda one: free[one])
    text = f"{free[folder] / (1 << 30):.1f} GiB are free for {folder}"
    if free[folder] >= _SCARCE_BYTES:
        return ok(Check.SPACE, text)
    verdict = failed if free[folder] < _FULL_BYTES else warning
    return verdict(Check.SPACE, text, "sudo journalctl --vacuum-size=100M && sudo apt clean", Topic.FULL_DISK)


def _writable(machine: Machine) -> Finding:
    options = _options_of_root(machine.text("/proc/mounts"))
    if options is None:
        return skipped(Check.WRITABLE, "the root file system is not listed in /proc/mounts")
    if "ro" not in options:
        return ok(Check.WRITABLE, "the root file system can be written")
    if "ro" in (_options_of_root(machine.text("/etc/fstab")) or ()):
        return ok(Check.WRITABLE, "the root file system is read-only, as /etc/fstab says")
    return warning(
        Check.WRITABLE,
        "the root file system is read-only, and /etc/fstab does not say so: an SD card that fails looks "
        "like this, and the log ends with the next start",
        "sudo mount -o remount,rw / && dmesg | grep -i -e mmc -e ext4",
        Topic.FULL_DISK,
    )


def _options_of_root(table: str | None) -> tuple[str, ...] | None:
    """The options of / in a table of mounts; the last line counts, for it lies on top."""
    rows = [line.split() for line in (table or "").splitlines() if not line.lstrip().startswith("#")]
    found = [tuple(row[3].split(",")) for row in rows if len(row) > 3 and row[1] == "/"]
    return found[-1] if found else None
