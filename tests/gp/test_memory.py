from gpmpc.gp import _memory as memory


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
