"""`imudrv demo --full`: its scenarios are of one unit, and its commands are those of the programs."""

from importlib import import_module
from pathlib import Path

from imudrv.cli.demo import commands, write_scenarios
from imudrv.sim import scenario as scenarios


def test_all_scenarios_of_the_demo_are_of_one_unit_at_one_place(tmp_path: Path) -> None:
    write_scenarios(tmp_path)
    loaded = [
        scenarios.load(str(path)) for path in sorted(tmp_path.glob("*.yaml")) if path.name != "site.yaml"
    ]
    assert len(loaded) == 5
    assert all(one.unit == loaded[0].unit and one.site == loaded[0].site for one in loaded)
    assert len({one.seed for one in loaded}) > 1


def test_what_a_command_of_the_demo_reads_was_written_before(tmp_path: Path) -> None:
    write_scenarios(tmp_path)
    there = {path.name for path in tmp_path.iterdir()}
    for program, name, *arguments in commands():
        assert name in import_module(f"{program}.cli").COMMANDS
        written = {arguments[k + 1] for k, one in enumerate(arguments) if one in ("-o", "--report")}
        if name == "sim":
            written |= {arguments[k + 1] for k, one in enumerate(arguments) if one == "--truth"}
        files = {one for one in arguments if one.endswith((".yaml", ".raw", ".html"))}
        assert files - written <= there
        there |= written
    assert "unit.yaml" in there
