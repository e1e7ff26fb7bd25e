"""A file names code of what gpmpc lists, and of packages that its reader trusts."""

import importlib
import inspect
import re
import sys
from functools import partial
from pathlib import Path

import pytest

from gpmpc import _trust
from gpmpc.cli import _recorded_settings
from gpmpc.exceptions import DataError, SettingError

ROOT = Path(__file__).resolve().parents[1]
OWN = '''
import os
import subprocess
from functools import partial

import numpy as np
from numpy import save
from os import system
from gpmpc.systems import translational as vehicle
from gpmpc._files import write_whole


class Arm:
    """Its own."""

    def mass(self):
        return 1.0


def make(mass=1.0):
    return Arm()


heavy = partial(make, mass=2.0)
keep = partial(np.save, "file")
'''


@pytest.fixture
def own_package(tmp_path, monkeypatch):
    """A package of a user's, which imports what packages import."""
    folder = tmp_path / "robot_of_mine"
    folder.mkdir()
    (folder / "__init__.py").write_text("from robot_of_mine import arm\n")
    (folder / "arm.py").write_text(OWN)
    (folder / "broken.py").write_text("1 / 0\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    yield "robot_of_mine"
    for name in [name for name in sys.modules if name.startswith("robot_of_mine")]:
        del sys.modules[name]


@pytest.mark.parametrize(
    "name",
    ["arm.Arm", "arm.make", "arm.heavy", "arm.Arm.mass", "arm:make", "arm.vehicle"],
)
def test_a_trusted_packages_code_and_its_names_are_found(name, own_package):
    path = f"{own_package}.{name}"
    assert _trust.is_trusted(path, [own_package])
    assert callable(_trust.trusted_code(path, [own_package]))


@pytest.mark.parametrize(
    "name",
    [
        "arm.os.system",
        "arm.subprocess.call",
        "arm.np.save",
        "arm.save",
        "arm.system",
        "arm.keep",
        "arm.write_whole",
        "arm.os.path.os.system",
        "arm:os.system",
    ],
)
def test_what_a_trusted_package_only_imports_is_refused(name, own_package):
    path = f"{own_package}.{name}"
    with pytest.raises(DataError, match="is code of|only imports"):
        _trust.trusted_code(path, [own_package])


@pytest.mark.parametrize(
    "name", ["arm.make.__globals__", "arm..make", "arm make", "arm.make()", "arm/make"]
)
def test_what_is_no_plain_name_is_not_trusted(name, own_package):
    assert not _trust.is_trusted(f"{own_package}.{name}", [own_package])


def test_code_that_is_not_there_is_named_in_one_line(own_package):
    for name in ("arm.nothing", "nothing.at_all", "broken.make"):
        with pytest.raises(
            DataError, match=f"{name} cannot be imported here"
        ) as refusal:
            _trust.trusted_code(f"{own_package}.{name}", [own_package])
        assert "\n" not in str(refusal.value)


def test_a_part_of_a_package_can_be_trusted_alone(own_package):
    part = f"{own_package}.arm"
    assert _trust.is_trusted(f"{part}.make", [part])
    assert callable(_trust.trusted_code(f"{part}.make", [part]))
    for other in (f"{own_package}.armour.make", f"{own_package}.broken", own_package):
        assert not _trust.is_trusted(other, [part])


@pytest.mark.parametrize(
    "names",
    [
        "my_robot",
        3,
        ["my robot"],
        [None],
        ["os"],
        ["subprocess"],
        ["gpmpc"],
        [""],
        ["builtins"],
        ["hydra.utils"],
        ["../x"],
    ],
)
def test_what_cannot_be_trusted_is_a_setting_of_the_wrong_kind(names):
    with pytest.raises(SettingError, match=r"^trusted: "):
        _trust.trusted_packages("trusted", names)


def test_no_trust_is_none():
    assert _trust.trusted_packages("trusted", None) == ()
    assert _trust.trusted_packages("trusted", ["a", "b.c"]) == ("a", "b.c")
    assert not _trust.is_trusted("gpmpc.systems.pendulum", [])


def listed():
    for name in sorted(_trust.SETTINGS_CODE):
        module, _, attribute = name.rpartition(".")
        yield name, getattr(importlib.import_module(module), attribute)


def test_what_conf_calls_is_listed_and_what_is_listed_exists():
    called = set()
    for path in (*ROOT.glob("conf/**/*.yaml"), *ROOT.glob("docs/*.md")):
        called |= set(re.findall(r"_target_: (gpmpc\.[\w.]+)", path.read_text()))
    assert len(called) > 30
    assert called <= _trust.SETTINGS_CODE
    for name, code in listed():
        assert callable(code), name
        assert code.__module__.startswith("gpmpc."), name
        assert _trust.shipped_name(code) is not None


#: arguments of listed code that take a text: words, names, and what is guarded
#: (``_recorded_settings._ARGUMENTS``)
WORDS = {"attitude", "starts", "around", "name", "solver"}
FILES_THAT_ARE_READ = {"folder", "path"}
GUARDED = {"trusted", "environment", "make", "options"}
NAMES = {
    "units",
    "lost",
    "angles",
    "tracked",
    "rates",
    "pose",
    "names",
    "state_names",
    "input_names",
    "actuators",
    "joints",
    "sensors",
    "observation",
    "known",
    "settings",
    "parameters",
}
NUMBERS = {"lower", "upper", "F", "f", "Q", "R", "terminal", "weight", "reference"}
NUMBERS |= {"input_lower", "input_upper", "initial_input", "start", "goal", "region"}
CODE = {
    "h",
    "y",
    "dynamics",
    "scaling",
    "penalty",
    "references",
    "observe",
    "criterion",
    "constraints",
}


def test_code_with_guarded_arguments_has_one_listed_name():
    by_name = dict(listed())
    for guarded in _recorded_settings._ARGUMENTS:
        code = by_name[guarded]
        assert [name for name in by_name if by_name[name] is code] == [guarded]


def test_every_text_argument_of_listed_code_was_looked_at():
    looked_at = WORDS | FILES_THAT_ARE_READ | GUARDED | NAMES | NUMBERS | CODE
    unknown = []
    for name, code in listed():
        for argument in inspect.signature(code).parameters.values():
            kind = re.sub(r"<class '([\w.]*)'>", r"\1", str(argument.annotation))
            takes_text = re.search(r"\b(str|Path|Any|dict|Callable|_empty)\b", kind)
            if takes_text and argument.name not in looked_at:
                unknown.append(f"{name}: {argument}")
    assert not unknown


def test_partials_are_followed_to_the_function_that_they_call():
    assert _trust._home(partial(partial(re.compile, "x"), flags=0)) == "re"
