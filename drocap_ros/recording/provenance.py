"""Provenance of a session: versions, revision, configuration and model hashes."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping
from datetime import datetime, timezone
from pathlib import Path

from drocap_ros import __version__
from drocap_ros.revision import git_revision

#: Keys of a session's metadata.
CONFIGURATION, MODELS, CALIBRATION = "configuration", "models", "calibration"
_PACKAGES = ("numpy", "scipy", "onnxruntime", "opencv-python-headless", "av", "mcap", "pymavlink", "rclpy")


def session_provenance(namespace: str = "") -> dict[str, str]:
    """First metadata of a session: versions (JSON), git revision and namespace of the graph."""
    values = {"versions": json.dumps(_versions(), sort_keys=True)}
    revision = git_revision()
    if revision:
        values["git_revision"] = revision
    if namespace:
        values["namespace"] = namespace
    return values


def configuration_text(sections: Mapping[str, Mapping[str, object]]) -> str:
    """Parameters by node as YAML, in the form of a configuration file."""
    import yaml

    content = {f"/**/{name}": {"ros__parameters": dict(values)} for name, values in sorted(sections.items())}
    return str(yaml.safe_dump(content, sort_keys=True))


def model_hashes(folder: str | Path) -> str:
    """SHA-256 of the networks in a folder, as JSON by name; ``{}`` where there are none."""
    from drocap_ros.perception.models.fetch import sha256_of
    from drocap_ros.perception.models.runtime import network_files

    return json.dumps({path.name: sha256_of(path) for path in network_files(Path(folder))}, sort_keys=True)


def dated_name(now_ns: int, namespace: str) -> str:
    """Name of a new session, from the clock: ``session_20260131T235959Z``, in another namespace than ours with that."""
    moment = datetime.fromtimestamp(now_ns * 1e-9, tz=timezone.utc)
    drone = namespace.strip("/").replace("/", "_")
    return f"session_{moment:%Y%m%dT%H%M%SZ}" + (f"_{drone}" if drone not in ("", "drocap") else "")


def _versions() -> dict[str, str]:
    from importlib.metadata import distributions

    ours = {"drocap_ros": __version__, "python": platform.python_version(), "machine": platform.machine()}
    there = {d.metadata["Name"]: d.version for d in distributions() if d.metadata["Name"] in _PACKAGES}
    return {**ours, **there}
