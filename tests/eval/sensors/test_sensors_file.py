"""The sensors file: read and written alike, grown, and refused by name, value and limits."""

import pytest

from eval.sensors import SENSORS, sensors_file
from tracks.common.provenance import stamp, stamp_text

STEREO = '[[depth]]\nkind = "stereo"\n'


@pytest.mark.parametrize("name", sensors_file.shipped_sensors())
def test_a_shipped_file_reads_back_equal_and_grows_within_its_limits(name, tmp_path):
    sensors = sensors_file.load_sensors(name)
    assert sensors.name == name
    sensors_file.save_sensors(sensors, tmp_path / "again.toml", "a comment\x1b")
    assert sensors_file.load_sensors(tmp_path / "again.toml") == sensors
    assert f"# {stamp_text(stamp(1, None))}\n" in (tmp_path / "again.toml").read_text()
    assert sensors_file.scale_sensors(sensors, 0.0) == sensors_file.PERFECT
    for model, values in sensors_file.scale_sensors(sensors, 1e6).models.items():
        sensor, own = SENSORS[model], sensors.models[model]
        for parameter, value in zip(sensor.parameters, values, strict=True):
            usual = getattr(own, parameter.name)
            moves = parameter.name in sensor.grows and usual != parameter.neutral
            assert value == (parameter.high if moves else usual), parameter.name


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('[state]\nkind = "state_nose"\n', "unknown sensor model 'state_nose'. Did you mean"),
        (f"{STEREO}noize = 1\n", "'noize' in .depth.0.. is unknown. Did you mean 'noise'"),
        (f"{STEREO}noise = -1\n", "depth.0..noise is -1, allowed is a number"),
        ('[depth]\nkind = "stereo"\nnoise = nan\n', "depth.noise is nan, allowed is a number"),
        (STEREO + STEREO, "depth.1..kind is 'stereo', allowed is each model once"),
        ('[gates]\nkind = "stereo"\n', r"allowed is a model of .gates.; put this one under"),
        ("[[depth]]\nnoise = 1\n", "has no 'kind'; add it"),
        ("depth = 3\n", "depth is 3, allowed is tables"),
        ("schema = 2\n", "schema is 2, allowed is 1: this version"),
        ("noise = 1\n", "key 'noise' at the top is unknown"),
    ],
)
def test_what_cannot_be_is_refused_by_name(text, words, tmp_path):
    path = tmp_path / "odd.toml"
    path.write_text('name = "odd"\n' + text)
    with pytest.raises(sensors_file.SensorsFileError, match=words) as error:
        sensors_file.load_sensors(path)
    assert str(path) in str(error.value)


def test_a_file_needs_no_name(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(f"schema = 1\n{STEREO}noise = 0.1\n")
    sensors = sensors_file.load_sensors(path)
    assert sensors == sensors_file.sensor_set({"stereo": {"noise": 0.1}}, name="custom")


def test_unknown_names_say_what_there_is():
    with pytest.raises(ValueError, match="unknown sensors .or file. 'vioo'. Did you mean 'vio'"):
        sensors_file.load_sensors("vioo")
    with pytest.raises(sensors_file.SensorsFileError, match="no such file; shipped by name: all, "):
        sensors_file.load_sensors("none/there.toml")
    with pytest.raises(ValueError, match="state.0..jitter is 1.5, allowed is a number from 0 to 1"):
        sensors_file.sensor_set({"delay": {"jitter": 1.5}})
