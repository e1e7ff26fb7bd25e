import pytest

from gpmpc.exceptions import DataError
from gpmpc.gp import _memory as memory
from gpmpc.gp import _training


def test_a_running_process_has_some_memory_left():
    free = memory.available_memory()
    assert free is None or free > 2**20


def test_the_tightest_control_group_above_the_process_counts_and_file_pages_are_free(tmp_path):
    own = tmp_path / "own"
    own.write_text("1:cpu:/x\n0::/job/step\n")
    for folder, limit, used, pages in (("job/step", "max", 0, 0), ("job", "1000", 700, 200), (".", "5000", 4900, 0)):
        (tmp_path / "groups" / folder).mkdir(parents=True, exist_ok=True)
        (tmp_path / "groups" / folder / "memory.max").write_text(f"{limit}\n")
        (tmp_path / "groups" / folder / "memory.current").write_text(f"{used}\n")
        statistics = f"anon 1\ninactive_file {pages}\nactive_file 7\n"
        (tmp_path / "groups" / folder / "memory.stat").write_text(statistics)
    assert memory._by_control_group(tmp_path / "groups", own) == 100
    (tmp_path / "groups" / "memory.max").unlink()
    assert memory._by_control_group(tmp_path / "groups", own) == 500
    assert memory._by_control_group(tmp_path / "groups", tmp_path / "none") is None


def test_the_kernels_word_is_read_and_may_be_missing(tmp_path):
    (tmp_path / "meminfo").write_text("MemTotal: 9 kB\nMemAvailable:     3 kB\n")
    assert memory._by_kernel(tmp_path / "meminfo") == 3 * 1024
    assert memory._by_kernel(tmp_path / "nothing") is None


@pytest.mark.parametrize(
    ("by_kernel", "by_group", "free"),
    [(700, 500, 500), (500, 700, 500), (None, 300, 300), (900, None, 900), (9, -9, 0)],
)
def test_what_is_left_is_the_least_that_anybody_leaves(by_kernel, by_group, free, monkeypatch):
    monkeypatch.setattr(memory, "_by_kernel", lambda: by_kernel)
    monkeypatch.setattr(memory, "_by_control_group", lambda: by_group)
    assert memory.available_memory() == free


def test_where_the_kernel_says_nothing_all_physical_memory_counts_or_nothing_is_known(monkeypatch):
    monkeypatch.setattr(memory, "_by_kernel", lambda: None)
    monkeypatch.setattr(memory, "_by_control_group", lambda: None)
    monkeypatch.setattr(memory.os, "sysconf", {"SC_PHYS_PAGES": 30, "SC_PAGE_SIZE": 4096}.__getitem__, raising=False)
    assert memory.available_memory() == 30 * 4096

    def unknown(_):
        raise ValueError

    monkeypatch.setattr(memory.os, "sysconf", unknown)
    assert memory.available_memory() is None


def test_a_training_that_does_not_fit_is_refused_with_the_points_that_would(monkeypatch):
    needed = 8 * 1000**2 * (2 + 2)  # [bytes]
    for free in (needed, None):
        monkeypatch.setattr(_training, "available_memory", lambda free=free: free)
        _training._check_memory(1000, 2)
    monkeypatch.setattr(_training, "available_memory", lambda: needed - 1)
    with pytest.raises(DataError, match="train on 999 points or fewer"):
        _training._check_memory(1000, 2)
    monkeypatch.setattr(_training, "available_memory", lambda: 2**30)
    message = "exact GPs of 20000 points and 3 outputs need 14.9 GiB, 2.98 GiB a kernel matrix; 1 GiB are available: "
    with pytest.raises(DataError, match=f"{message}train on 5181 points or fewer"):
        _training._check_memory(20_000, 3)
