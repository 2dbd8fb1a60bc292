"""Configuration of all components from one YAML file, one section per node.

The file has the form of a ROS 2 parameter file, so that ``drocap live --config FILE`` and
``ros2 run drocap_ros NODE --ros-args --params-file FILE`` read the same one::

    /**/pose_estimator:
      ros__parameters:
        threads: 2
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import get_type_hints

from drocap_ros.errors import InputError, ParameterError
from drocap_ros.export.stream_out_config import StreamOutConfig
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.parameters import Parameters, Values, read_yaml
from drocap_ros.perception.sources.base import ImageIngestConfig
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig, InitializerConfig
from drocap_ros.recording.mcap.session_config import SessionPlayerConfig, SessionRecorderConfig
from drocap_ros.simulation.flight_simulator.simulator_config import FlightSimulatorConfig
from drocap_ros.view.visualizer_config import VisualizerConfig


@dataclass(frozen=True)
class DrocapConfig:
    """Parameters of every component; each field has the name of its node."""

    image_ingest: ImageIngestConfig = field(default_factory=ImageIngestConfig)
    pose_estimator: PoseEstimatorConfig = field(default_factory=PoseEstimatorConfig)
    initializer: InitializerConfig = field(default_factory=InitializerConfig)
    bundle_adjuster: BundleAdjusterConfig = field(default_factory=BundleAdjusterConfig)
    mavlink_bridge: MavlinkBridgeConfig = field(default_factory=MavlinkBridgeConfig)
    session_recorder: SessionRecorderConfig = field(default_factory=SessionRecorderConfig)
    session_player: SessionPlayerConfig = field(default_factory=SessionPlayerConfig)
    visualizer: VisualizerConfig = field(default_factory=VisualizerConfig)
    stream_out: StreamOutConfig = field(default_factory=StreamOutConfig)
    flight_simulator: FlightSimulatorConfig = field(default_factory=FlightSimulatorConfig)

    def section(self, component: str) -> Parameters:
        """Parameters of the component with this node name."""
        value: Parameters = getattr(self, component)
        return value

    def replace(self, component: str, **values: object) -> DrocapConfig:
        """Copy with some values of one component changed; the values are validated."""
        changes: Values = {component: dataclasses.replace(self.section(component), **values)}
        return dataclasses.replace(self, **changes)

    def to_parameter_file(self) -> Values:
        """The whole configuration in the form of a ROS 2 parameter file."""
        return {
            f"/**/{spec.name}": {"ros__parameters": dataclasses.asdict(self.section(spec.name))}
            for spec in dataclasses.fields(self)
        }


def section_types() -> dict[str, type[Parameters]]:
    """Component name -> its parameter class."""
    return dict(get_type_hints(DrocapConfig).items())


def load_config(path: str | Path | None) -> DrocapConfig:
    """Read a configuration file; missing sections and values, and all of them without a file, keep their defaults."""
    if path is None:
        return DrocapConfig()
    path = Path(path)
    data = read_yaml(path, "a configuration file")
    return parse_config(data or {}, str(path))


def parse_config(data: object, where: str) -> DrocapConfig:
    """Configuration from the content of a parameter file; ``where`` names the file in errors."""
    if not isinstance(data, Mapping):
        raise InputError(f"{where}: expected a mapping of components, found {type(data).__name__}")
    types = section_types()
    sections: dict[str, Parameters] = {}
    for key, body in data.items():
        name = str(key).rstrip("/").rsplit("/", 1)[-1]
        if name not in types:
            raise ParameterError(f"{where}: unknown component {key!r}; expected one of {', '.join(types)}")
        values = body.get("ros__parameters", body) if isinstance(body, Mapping) else body
        if not isinstance(values, Mapping):
            raise ParameterError(f"{where}: {key}: expected 'ros__parameters:' with values, found {body!r}")
        # A ROS parameter, not one of the component.
        if values.get("use_sim_time"):
            raise ParameterError(
                f"{where}: {name}.use_sim_time: expected false, since drocap's commands use the machine's clock, got"
                f" {values['use_sim_time']}; leave it out, and give it to nodes that are started one by one"
            )
        ours = {str(k): v for k, v in values.items() if k != "use_sim_time"}
        sections[name] = types[name].from_mapping(ours, f"{where}: {name}")
    return DrocapConfig(**sections)  # type: ignore[arg-type]
