"""What Ray says of a task becomes the reason in the run's folder.

Ray is made up here; ``make cluster`` asks a real one.
"""

import json
import sys
from dataclasses import dataclass
from types import SimpleNamespace

import pytest

from gpmpc.cli import _flying
from gpmpc.cli._flying import Flying
from gpmpc.cli._ray import Ray
from gpmpc.exceptions import GpmpcError, SettingError
from tests.cli.launched import fly, in_chunks, jobs_of


class RayError(Exception):
    pass


class RayTaskError(RayError):
    def __init__(self, cause):
        self.cause = cause


@dataclass(eq=False)
class Task:
    """What a submitted task stands for; tasks are told apart."""

    error: Exception | None
    result: object = None


class MadeUpRay:
    """Flies tasks when they are submitted; some of them end otherwise."""

    util = SimpleNamespace(get_node_ip_address=lambda: "10.0.0.7")

    def __init__(self):
        self.ends = []  # exceptions by which the next tasks end; None flies one
        self.refusal = None
        self.asked = []
        self.exceptions = SimpleNamespace(RayError=RayError, RayTaskError=RayTaskError)

    def is_initialized(self):
        return False

    def init(self, **settings):
        self.asked.append(settings)
        if self.refusal is not None:
            raise self.refusal

    def remote(self, **settings):
        self.asked.append(settings)
        return lambda function: SimpleNamespace(
            remote=lambda *arguments: self._task(function, arguments)
        )

    def _task(self, function, arguments):
        end = self.ends.pop(0) if self.ends else None
        return Task(error=end, result=function(*arguments) if end is None else None)

    def wait(self, tasks, num_returns):
        return tasks[:num_returns], tasks[num_returns:]

    def get(self, task):
        if task.error is not None:
            raise task.error
        return task.result

    def cancel(self, task, force):
        raise AssertionError("nothing is to be cancelled here")

    def shutdown(self):
        pass


@pytest.fixture
def ray(monkeypatch):
    made_up = MadeUpRay()
    monkeypatch.setitem(sys.modules, "ray", made_up)
    monkeypatch.setattr(_flying, "_LATE", 0.0)
    return made_up


def flown(tree, jobs, work=fly):
    settings = {"init": {"address": "auto"}, "remote": {"num_cpus": 1}}
    states = {}
    Flying(
        launcher=Ray(tree, settings),
        work=work,
        chunked=in_chunks(1),
        on_settled=lambda job, state: states.update({job.folder.path: state.value}),
        retries=1,
    ).fly(jobs)
    return [states[job.folder.path] for job in jobs]


def ended_by(name, text="somewhere"):
    return type(name, (RayError,), {})(text)


@pytest.mark.parametrize(
    ("end", "kind", "words"),
    [
        (ended_by("OutOfMemoryError"), "memory", "hydra.launcher.ray.remote.memory"),
        (ended_by("TaskCancelledError"), "cancelled", "its task was cancelled"),
        (RayTaskError(OSError("no space\nleft")), "error", "OSError: no space left"),
        (
            ended_by("RuntimeEnvSetupError", "no such image"),
            "error",
            "Ray could not fly it: no such image (RuntimeEnvSetupError)",
        ),
    ],
)
def test_a_task_that_ray_ends_is_a_failed_run(end, kind, words, ray, tmp_path):
    ray.ends = [None, end]
    jobs = jobs_of(tmp_path, "flies", "flies", "flies")
    assert flown(tmp_path, jobs) == ["finished", "failed", "finished"]
    error = json.loads((jobs[1].folder.path / "error.json").read_text())
    assert words in error["error"]
    assert error["kind"] == kind
    assert ray.asked[0]["address"] == "auto"
    assert ray.asked[1] == {"num_cpus": 1, "max_retries": 0}


@pytest.mark.parametrize("name", ["NodeDiedError", "WorkerCrashedError"])
def test_a_run_whose_node_or_worker_died_flies_again(name, ray, tmp_path):
    jobs = jobs_of(tmp_path, "flies", "flies")
    ray.ends = [ended_by(name)]
    assert flown(tmp_path, jobs) == ["finished", "finished"]
    more = jobs_of(tmp_path / "more", "flies")
    ray.ends = [ended_by(name), ended_by(name)]
    assert flown(tmp_path, more) == ["failed"]


def test_a_node_that_does_not_see_the_folder_is_named(ray, tmp_path):
    (job,) = jobs_of(tmp_path, "flies")
    assert flown(tmp_path, [job], work=lambda chunk: []) == ["failed"]
    error = json.loads((job.folder.path / "error.json").read_text())
    assert error["host"].endswith("(10.0.0.7)")
    assert "says that it flew this run, and it is not in the folder" in error["error"]


def test_a_cluster_that_is_not_there_is_one_line(ray, tmp_path):
    ray.refusal = ConnectionError("could not\nfind any running Ray instance")
    with pytest.raises(GpmpcError, match="Ray: could not find any running Ray inst"):
        flown(tmp_path, jobs_of(tmp_path, "flies"))


def test_without_ray_its_launcher_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(SettingError, match=r"pip install 'gpmpc\[ray\]'"):
        Ray(tmp_path, {"init": {}, "remote": {}})
