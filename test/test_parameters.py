import dataclasses
from dataclasses import dataclass

import pytest

from drocap_ros.config import DrocapConfig, load_config, parse_config, section_types
from drocap_ros.errors import InputError, ParameterError
from drocap_ros.parameters import Parameters, param


@dataclass(frozen=True)
class Example(Parameters):
    radius_m: float = param(6.0, "distance", unit="m", minimum=2, maximum=50)
    count: int = param(3, "how many", minimum=1)
    mode: str = param("a", "which", choices=("a", "b"))
    on: bool = param(True, "whether")


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"radius_m": -1.0}, r"Example.radius_m: expected 2 to 50 m, got -1.0"),
        ({"radius_m": float("nan")}, "expected a finite number"),
        ({"radius_m": "6"}, "expected float"),
        ({"count": 0}, "expected at least 1"),
        ({"count": True}, "expected int"),
        ({"count": 2.0}, "expected int"),
        ({"mode": "c"}, "expected one of a, b"),
        ({"on": 1}, "expected bool"),
        ({"radius": 3.0}, "unknown parameter 'radius'"),
    ],
)
def test_unusable_value_is_refused_with_its_range(values, words):
    with pytest.raises(ParameterError, match=words) as caught:
        Example.from_mapping(values)
    assert "\n" not in str(caught.value)


def test_integer_is_accepted_for_a_float():
    assert Example(radius_m=7).radius_m == 7.0


@pytest.mark.parametrize("component", section_types())
def test_every_parameter_has_a_description(component):
    for spec in dataclasses.fields(section_types()[component]):
        assert spec.metadata["description"], f"{component}.{spec.name}"


def test_configuration_read_back_from_its_parameter_file_is_equal(tmp_path):
    import yaml

    config = DrocapConfig().replace("image_ingest", source="flight.mp4", jpeg_quality=77)
    path = tmp_path / "config.yaml"
    path.write_text(yaml.safe_dump(config.to_parameter_file()))
    assert load_config(path) == config


def test_every_shipped_configuration_loads(root):
    files = sorted((root / "config").glob("*.yaml"))
    assert files
    for path in files:
        load_config(path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[1, 2", "expected YAML"),
        ("- a", "expected a mapping of components"),
        ("pose_estimater: {}", "unknown component"),
        ("/**/pose_estimator: 3", "expected 'ros__parameters:'"),
        ("/**/pose_estimator: {ros__parameters: {threads: 0}}", "pose_estimator|PoseEstimatorConfig"),
    ],
)
def test_bad_configuration_file_is_refused_in_one_line(tmp_path, text, words):
    path = tmp_path / "config.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        load_config(path)
    assert "\n" not in str(caught.value)


def test_missing_configuration_file_is_refused(tmp_path):
    with pytest.raises(InputError, match="No such file"):
        load_config(tmp_path / "none.yaml")


def test_parameters_of_ros_itself_are_ignored():
    config = parse_config({"/drocap/initializer": {"ros__parameters": {"use_sim_time": False}}}, "x")
    assert config == DrocapConfig()


def test_simulated_time_in_a_configuration_file_is_refused():
    with pytest.raises(InputError, match=r"x: initializer.use_sim_time: expected false, .*, got True; leave it out"):
        parse_config({"/drocap/initializer": {"ros__parameters": {"use_sim_time": True}}}, "x")
