"""All checks before a flight, in the order of the table."""

from __future__ import annotations

from collections.abc import Sequence

from drocap_ros.flight.autopilot.autopilot import Level
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.conditions import Condition
from drocap_ros.flight.preflight.findings import Finding, Verdict, check, graded
from drocap_ros.flight.preflight.link_checks import link_findings
from drocap_ros.flight.preflight.measured import LASTING, Measured
from drocap_ros.flight.preflight.setup_checks import Setup, setup_findings
from drocap_ros.flight.preflight.vehicle_checks import vehicle_findings


def all_findings(config: MavlinkBridgeConfig, setup: Setup, measured: Measured) -> list[Finding]:
    """Every check.

    A condition for motion that fails and that no check explains is a finding of its own, so that no condition of the
    bridge can be forgotten here.
    """
    found = [*setup_findings(config, setup, measured.vehicle)]
    if not measured.heard:
        return [*found, _silence(config, measured)]
    found += link_findings(config, measured)
    found += [_no_attitude()] if measured.vehicle is None else vehicle_findings(config, measured, measured.vehicle)
    explained = {code for finding in found if finding.level != Level.OK for code in finding.conditions}
    found += [_unexplained(failed, share) for failed, share in measured.conditions if failed.code not in explained]
    return found


def is_ready(found: Sequence[Finding]) -> bool:
    """Whether nothing is missing."""
    return all(finding.level != Level.MISSING for finding in found)


def _unexplained(failed: Condition, share: float) -> Finding:
    level, words = graded(missing=share > LASTING, warning=True), f"{failed} ({share:.0%} of the time)"
    verdict = Verdict(level, words, "none that fails", "see docs/flight.md, conditions for motion", {"share": share})
    return verdict.finding(f"condition_{failed.code.name.lower()}", "condition for motion", (failed.code,))


@check("vehicle", "vehicle")
def _no_attitude() -> Verdict:
    remedy = "wait until the autopilot has started; check that it may send ATTITUDE_QUATERNION"
    return Verdict(Level.MISSING, "no attitude", "attitude and position", remedy)


@check("link", "link")
def _silence(config: MavlinkBridgeConfig, measured: Measured) -> Verdict:
    data, remedy = "nothing", "check the cable, the power and the URL"
    if measured.unsigned_count:
        data = f"{measured.unsigned_count} messages that are not signed with the key of signing_key_file"
        remedy = "give the autopilot the same key, or remove signing_key_file"
    elif measured.bad_count:
        data = f"{measured.bad_count} pieces of data that are no MAVLink"
        remedy = "check the baud rate, and that the port's protocol is MAVLink 2"
    elif config.target_system_id:
        remedy += f", and target_system_id {config.target_system_id}"
    found = f"{data} {measured.bridge or f'on {config.url}'}"
    values = {"bad": measured.bad_count, "unsigned": measured.unsigned_count}
    return Verdict(Level.MISSING, found, "an autopilot's heartbeat", remedy, values)
