"""The study of the camera's motion."""

from __future__ import annotations

import csv

from walking import write_mocap

from drocap_ros.cli import main
from lab.commands import build_parser
from lab.studies.protocol import protocol_sequences
from lab.studies.rotation import measure, rotation_markdown, rotation_study


def test_rotation_command_writes_its_tables(tmp_path, capsys):
    write_mocap(tmp_path, "a", frames=160)
    write_mocap(tmp_path, "short", frames=40)
    out = tmp_path / "out"
    words = ["rotation", str(tmp_path), "--speeds", "0", "25", "--methods", "ba", "initial", "--quiet"]
    assert main([*words, "--out", str(out)], parser=build_parser()) == 0
    text = capsys.readouterr().out
    assert "mean over 1 sequences" in text
    assert text == (out / "rotation.md").read_text(encoding="utf-8")
    with (out / "rotation.csv").open(encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    assert [(r["method"], r["speed_deg_s"]) for r in lines] == [
        ("ba", "0.0000"), ("ba", "25.0000"), ("initial", "0.0000"), ("initial", "25.0000"),
    ]  # fmt: skip
    assert (out / "rotation.png").read_bytes().startswith(b"\x89PNG")
    assert main([words[0], str(tmp_path / "absent")], parser=build_parser()) == 2
    assert main([*words, "--limit", "0"], parser=build_parser()) == 2
    assert main(["rotation", str(tmp_path), "--speeds", "9999"], parser=build_parser()) == 2


def test_study_rows_are_independent_of_the_number_of_processes(tmp_path):
    write_mocap(tmp_path, "a", frames=151)
    one, two = (
        rotation_study(protocol_sequences(tmp_path), speeds_deg_s=[25.0], methods=["initial"], processes=count)
        for count in (1, 2)
    )
    assert [r.errors.per_group_mm for r in one] == [r.errors.per_group_mm for r in two]
    assert [r.limb_spread for r in one] == [r.limb_spread for r in two]
    assert "single-view initialization" in rotation_markdown(one)


def test_default_method_is_accurate_and_unmirrored_on_unseen_people(shared):
    for sequence in protocol_sequences(shared / "mocap" / "dev", limit=2):
        row = measure(sequence, "ba", 25.0, noisy=True)
        assert not row.errors.mirrored
        assert row.errors.error_mm < 40.0
