"""A note for who protects a program of a systemd service that systemd starts again by itself."""

from __future__ import annotations

from checkpoint.linux.systemd_service import restarted_service
from failover.cli.agent_service import SERVICE


def notes_of_service(pid: int) -> tuple[str, ...]:
    """One sentence with the cure, where systemd would start a second copy; none where it would not, or that is not known."""
    service = restarted_service(pid)
    if service is None or service.unit == SERVICE:
        return ()
    return (
        f"pid {pid} belongs to {service.unit}, which says Restart={service.restart}: when this process ends, systemd may start a "
        'second copy beside the one that resumes; declare it in agent.toml instead ([tasks."NAME"]) and disable the service, '
        f"or: systemctl edit {service.unit}, with Restart=no in [Service]",
    )
