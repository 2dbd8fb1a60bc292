"""Mutants of the product: each changes one place, and the tests that judge it are those of its module and room."""

from lab.commands.mutants import judges_of, mutants, survives

SOURCE = '''"""Not changed: 1 < 2."""
X = 3
def f(a: int = 1) -> int:
    if a < 2 and not a:
        raise ValueError("1 < 2")
    return min(a, -X)
'''


def test_each_mutant_changes_one_place_and_no_word():
    found = mutants("x.py", SOURCE)
    assert {mutant.line for mutant in found} == {2, 4, 6}
    changed = {mutant.after for mutant in found}
    assert {"if (a >= 2) and not a:", "if (a < 2 or not a):", "return (max(a, -X))", "return min(a, (X))"} <= changed
    for mutant in found:
        assert sum(a != b for a, b in zip(mutant.source.splitlines(), SOURCE.splitlines(), strict=True)) == 1
        compile(mutant.source, "x.py", "exec")


def test_a_module_is_judged_by_the_tests_that_import_it_first():
    near, elsewhere, folder, room, flights = judges_of("drocap_ros/flight/mavlink/guardian.py")
    assert near[0] == "test/flight/mavlink/test_guardian.py"
    assert not any(file.startswith("test/flight/") for file in elsewhere)
    assert "test/flight/mavlink/test_commands.py" in folder
    assert "test/flight/orbit/test_safety.py" in room
    assert "test/lab/flights/test_faults.py" in flights


def test_a_mutant_that_a_test_notices_is_killed(root):
    path = "drocap_ros/flight/autopilot/coasting.py"
    source = (root / path).read_text()
    assert survives(mutants(path, source)[0]._replace(source="raise ValueError\n"), 100.0) == ""
