from types import SimpleNamespace

from drocap_ros.cli.graph.top import Dashboard


def status(name, level, text, **values):
    pairs = [SimpleNamespace(key=key, value=value) for key, value in values.items()]
    return SimpleNamespace(name=name, level=level, message=text, values=pairs)


def test_the_table_shows_each_node_once_with_its_latest_words():
    from rich.console import Console

    dashboard = Dashboard()
    dashboard.take(SimpleNamespace(status=[status("drocap/initializer", b"\x00", "running", poses="3")]))
    dashboard.take(SimpleNamespace(status=[status("drocap/pose_estimator", b"\x01", "no subject in view")]))
    dashboard.take(SimpleNamespace(status=[status("drocap/initializer", b"\x02", "gone wrong", poses="7")]))
    console = Console(width=120, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    console.print(dashboard.table())
    text = console.export_text()
    assert text.count("drocap/initializer") == 1
    assert "poses 7" in text
    assert "error" in text
    assert "gone wrong" in text
    assert "running" not in text
    assert "warning" in text


def test_a_latency_that_is_no_number_is_shown_as_unknown():
    dashboard = Dashboard()
    values = {"latency_p50_ms": "12.4", "latency_p95_ms": "slow", "latency_p99_ms": ""}
    dashboard.take(SimpleNamespace(status=[status("drocap/x", b"\x00", "running", **values)]))
    (cell,) = dashboard.table().columns[3].cells
    assert cell == "12 / nan / nan"


def test_words_with_brackets_are_shown_as_they_are():
    from rich.console import Console

    dashboard = Dashboard()
    text = "skeleton: expected body15, got '[/b]'; recording to walk[take]"
    dashboard.take(SimpleNamespace(status=[status("drocap/x", b"\x01", text, last_refused="[/i]")]))
    console = Console(width=300, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    console.print(dashboard.table())
    shown = console.export_text()
    assert text in shown
    assert "[/i]" in shown


def test_below_the_table_stands_whether_this_machine_keeps_up():
    dashboard = Dashboard()
    assert str(dashboard.table().caption) == ""
    for name, share in (("drocap/a", "0"), ("drocap/b", "many")):
        dashboard.take(SimpleNamespace(status=[status(name, b"\x00", "running", passed_over_percent=share)]))
    assert str(dashboard.table().caption) == "this machine keeps up"
    dashboard.take(SimpleNamespace(status=[status("drocap/b", b"\x00", "running", passed_over_percent="12")]))
    assert str(dashboard.table().caption) == "this machine passes over 12 % in drocap/b"
    assert str(dashboard.table("drocap/a").caption) == ""
