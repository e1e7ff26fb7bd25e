import pytest
import torch

from gpmpc.exceptions import DataError
from gpmpc.gp import SparseTrainer, _memory
from gpmpc.gp._memory import available_memory


def write(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def write_group(path, limit, used, pages):
    write(path / "memory.max", f"{limit}\n")
    write(path / "memory.current", f"{used}\n")
    write(path / "memory.stat", f"anon 1\ninactive_file {pages}\nactive_file 7\n")


def test_a_running_process_has_some_memory_left():
    free = available_memory()
    assert free is None or free > 2**20


def test_the_tightest_control_group_counts_without_file_pages(tmp_path):
    groups = tmp_path / "sys/fs/cgroup"
    write(tmp_path / "proc/self/cgroup", "1:cpu:/x\n0::/job/step\n")
    for folder, limit, used, pages in (
        ("job/step", "max", 0, 0),
        ("job", "1000", 700, 200),
        (".", "5000", 4900, 0),
    ):
        write_group(groups / folder, limit, used, pages)
    assert available_memory(tmp_path) == 100
    (groups / "memory.max").unlink()
    assert available_memory(tmp_path) == 500
    write_group(groups / "job", 1000, 1009, 0)
    assert available_memory(tmp_path) == 0


@pytest.mark.parametrize(
    ("by_kernel", "by_group", "free"),
    [(7, 5, 5), (5, 7, 5), (None, 3, 3), (9, None, 9), (None, None, None)],
)
def test_what_is_left_is_the_least_that_anybody_leaves(
    by_kernel, by_group, free, tmp_path
):
    if by_kernel is not None:
        write(
            tmp_path / "proc/meminfo",
            f"MemTotal: 9 kB\nMemAvailable:     {by_kernel} kB\n",
        )
    if by_group is not None:
        write(tmp_path / "proc/self/cgroup", "0::/\n")
        write_group(tmp_path / "sys/fs/cgroup", 1024 * by_group, 0, 0)
    assert available_memory(tmp_path) == (None if free is None else 1024 * free)


def test_a_training_too_large_is_refused_with_points_that_fit(monkeypatch):
    needed = 8 * 1000**2 * (2 + 2)  # [bytes]
    for free in (needed, None):
        monkeypatch.setattr(_memory, "available_memory", lambda free=free: free)
        _memory.check_memory(1000, 2)
    monkeypatch.setattr(_memory, "available_memory", lambda: needed - 1)
    with pytest.raises(DataError, match="train on 999 points or fewer"):
        _memory.check_memory(1000, 2)
    monkeypatch.setattr(_memory, "available_memory", lambda: 2**30)
    message = (
        "exact GPs of 20000 points and 3 outputs need 14.9 GiB, 2.98 GiB a kernel "
        "matrix; 1 GiB are available: "
    )
    with pytest.raises(DataError, match=f"{message}train on 5181 points or fewer"):
        _memory.check_memory(20_000, 3)


def test_a_sparse_training_too_large_is_refused_before_the_work(monkeypatch):
    needed = 8 * 2 * 50 * 1000  # [bytes]
    for free in (needed, None):
        monkeypatch.setattr(_memory, "available_memory", lambda free=free: free)
        _memory.check_sparse_memory(1000, 2, inducing=50)
    monkeypatch.setattr(_memory, "available_memory", lambda: needed - 1)
    with pytest.raises(DataError, match="take 49 inducing points or fewer"):
        _memory.check_sparse_memory(1000, 2, inducing=50)
    monkeypatch.setattr(_memory, "available_memory", lambda: 2**30)
    x = torch.zeros(200_000, 1, dtype=torch.float64)
    message = (
        "sparse GPs of 200000 points, 2000 inducing points and 6 outputs need 17.9 "
        "GiB; 1 GiB are available: take 111 inducing points or fewer"
    )
    with pytest.raises(DataError, match=message):
        SparseTrainer(inducing=2000).fit(x, x.expand(-1, 6), 0, "value")
