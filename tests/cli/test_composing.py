"""Settings composed once and varied: the same as Hydra composes for every run alone."""

import shutil

import hydra
import pytest
from hydra.errors import HydraException
from omegaconf import OmegaConf

from gpmpc.cli import _settings
from gpmpc.cli._composing import Composer
from gpmpc.cli._overrides import choices, combinations
from gpmpc.cli._settings import without_hydra
from gpmpc.exceptions import SettingError

MANY = [
    ["seed=3"],
    ["seed=3", "seed=4"],
    ["seed=-1", "steps=007", "horizon=1e1", "data.size=1_0"],
    ["system=pendulum", "system.mass=0.5", "plant.mass=2", "seed=1"],
    ["system.mass=0.5", "system=pendulum"],
    ["controller=lqr", "launcher=joblib", "hydra.launcher.n_jobs=3"],
    ["controller=paper", "propagation=unscented", "horizon=5"],
    ["horizon=${steps}", "steps=7"],
    ["noise.process=[0.1,${seed}]", "noise.input='0.1'"],
    ["plant={mass: 0.9}", "plant.mass=0.8", "seed=2"],
    ["plant.mass=0.8", "plant={mass: 0.9}", "seed=2"],
    ["+plant.note=1", "plant.note=2", "plant.mass=3"],
    ["++seed=5", "seed=6"],
    ["~noise", "seed=6"],
    ["~data.samples", "data.size=5", "data=random"],
    ["learning=episodes", "steps=3", "learning.episodes=2"],
    ["controller.problem.cost.Q=[1,2]", "controller.problem.cost.Q.0=5"],
    ["disturbances=[{_target_: gpmpc.simulation.Dropout, start: 2, stop: 3}]"],
    ["trajectory=goal", "data=random", "data.samples=25", "nominal={mass: 0.8}"],
]


@pytest.fixture(autouse=True)
def composing(tmp_path, monkeypatch):
    """Settings in a folder that a test may add files to."""
    shutil.copytree(_settings.config_folder(), tmp_path / "conf")
    monkeypatch.setattr(_settings, "config_folder", lambda: tmp_path / "conf")
    with _settings.settings_folders():
        yield tmp_path / "conf"


def composer(name="run"):
    return Composer(name, hydra.compose(name, [], return_hydra_config=True))


def by_hydra(words, name="run"):
    composed = hydra.compose(name, words, return_hydra_config=True)
    return without_hydra(composed), dict(composed.hydra.runtime.choices)


def test_all_settings_are_those_that_hydra_composes():
    shared = composer()
    expected = [by_hydra(words) for words in MANY]
    # once composed, and once taken from what was
    rounds = [*zip(MANY, expected, strict=True)] * 2
    for words, (config, options) in rounds:
        composed = shared.composed(words)
        assert composed.config() == config, words
        assert dict(composed.options) == options
        one, other = (OmegaConf.to_yaml(each) for each in (composed.config(), config))
        assert one == other
        one, other = (
            OmegaConf.to_yaml(each, resolve=True)
            for each in (composed.config(), config)
        )
        assert one == other, words


def test_a_thousand_seeds_are_composed_once(monkeypatch):
    shared = composer()
    composed = []
    original = hydra.compose
    monkeypatch.setattr(
        hydra, "compose", lambda *a, **b: composed.append(a) or original(*a, **b)
    )
    for words in combinations(["controller=convex,lqr", "seed=range(500)", "steps=2"]):
        config = shared.composed(words)
    assert len(composed) == 2
    assert config.config().seed == 499
    assert config.config().steps == 2


@pytest.mark.parametrize(
    "words", [["horizn=5"], ["controller=convx"], ["data.x.y=1"], ["+seed=1"]]
)
def test_what_hydra_refuses_is_refused_in_its_words(words):
    with pytest.raises(HydraException) as ours:
        composer().composed(["seed=1", *words])
    with pytest.raises(HydraException) as theirs:
        by_hydra(["seed=1", *words])
    assert str(ours.value) == str(theirs.value)


def test_settings_that_ask_hydra_are_composed_for_every_run(composing):
    (composing / "mine.yaml").write_text(
        "defaults: [run, _self_]\nwords: ${hydra:job.override_dirname}\n"
    )
    shared = composer("mine")
    for seed in (1, 2):
        config = shared.composed([f"seed={seed}"]).config()
        assert config.words == f"seed={seed}"
        assert config.seed == seed


def test_a_time_that_was_asked_for_once_stays(composing):
    (composing / "timed.yaml").write_text(
        "defaults: [run, _self_]\nfolder: ${now:%f}\n"
    )
    first = hydra.compose("timed", [], return_hydra_config=True)
    folder = first.folder
    shared = Composer("timed", first)
    for words in (["seed=1"], ["controller=lqr"]):
        assert shared.composed(words).config().folder == folder


def test_a_fingerprint_differs_where_a_result_may(tmp_path):
    shared = composer()

    def fingerprint(*words):
        return shared.composed(words).fingerprint()

    prints = [
        fingerprint(*words)
        for words in (
            ["seed=1"],
            ["seed=2"],
            ["seed='1'"],
            ["seed=1", "horizon=5"],
            ["seed=1", "controller=lqr"],
        )
    ]
    assert None not in prints
    assert len({*prints}) == len(prints)
    aside = ["folder=x", "chunk=3", "retries=1", "tracker=mlflow", "launcher=joblib"]
    assert fingerprint("seed=1", *aside) == prints[0]
    assert fingerprint("seed=1", "data=paper", "data.folder=${oc.env:HOME}") is None
    model = tmp_path / "model.safetensors"
    reading = ["model=saved", f"model.path={model}"]
    assert fingerprint(*reading) is None
    model.write_bytes(b"1")
    first = fingerprint(*reading)
    model.write_bytes(b"2")
    assert None not in (first, fingerprint(*reading))
    assert fingerprint(*reading) != first


def test_choices_are_in_hydras_own_spelling():
    words = ["b=1", "a= 1e0", "c='x'", "b=2", "folder=x", "chunk=5", "hydra.job.id=1"]
    assert choices([*words, "~d", "+e=1", "f=-7"]) == [
        "+e=1",
        "a=1.0",
        "b=2",
        "c='x'",
        "f=-7",
        "~d",
    ]


def test_own_files_that_would_not_be_read_are_named(composing, tmp_path):
    own = tmp_path / "own"
    (own / "system").mkdir(parents=True)
    content = (composing / "system" / "pendulum.yaml").read_bytes()
    (own / "system" / "pendulum.yaml").write_bytes(content)
    _settings.check_own_folder(own)
    (own / "system" / "mine.yaml").write_bytes(b"mass: 2")
    _settings.check_own_folder(own)
    (own / "system" / "pendulum.yaml").write_bytes(content + b"# heavier")
    with pytest.raises(SettingError, match=r"system/pendulum\.yaml has the name of"):
        _settings.check_own_folder(own)
