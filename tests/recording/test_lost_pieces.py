"""Damaged pieces of a recording are left out, the rest is read, the loss is said."""

import re
import struct
import time
import zlib
from collections import Counter
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import zstandard
from mcap.writer import Writer

from gpmpc.exceptions import RecordingError
from gpmpc.recording import (
    McapRecorder,
    RecordedSystem,
    _recorder,
    _recovery,
    read_run,
    recover,
)
from tests.recording import damage, runs, study

STEPS = 200  # of the flight
MOST_OF_A_CHUNK = 22  # steps of two seconds, and one more


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """A flight of 20 s, which is simulated in less, and its steps by number."""
    path = tmp_path_factory.mktemp("flight") / "run.mcap"
    rng = np.random.default_rng(0)
    steps = [runs.make_step(k, rng, horizon=3, qp=False) for k in range(STEPS)]
    with runs.recorder(path, chunk_size=256 * 1024) as recorder:
        for step in steps:
            recorder.record(step)
    return path.read_bytes(), {step.k: step for step in steps}


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A run of four chunks with a configuration, and its steps by number."""
    path = tmp_path_factory.mktemp("small") / "run.mcap"
    steps = runs.record_run(path, steps=20, config=20 * "seed: 7\n")
    return path.read_bytes(), {step.k: step for step in steps}


def read(data, folder):
    path = folder / "changed.mcap"
    path.write_bytes(data)
    return read_run(path)


def kinds(run):
    return [flaw.kind for flaw in run.flaws]


def is_right(run, steps):
    """Whether every step that was read is one of those recorded, with its numbers."""
    return all(
        k in steps
        and np.array_equal(run.states[row], steps[k].state)
        and np.array_equal(run.inputs[row], steps[k].input)
        and np.array_equal(run.plan_means[row], steps[k].decision.means)
        for row, k in enumerate(run.steps.tolist())
    )


def chunk_spans(data):
    return [span for span in damage._spans(data) if span[0] == damage.CHUNK]


def spoiled(data, place):
    changed = bytearray(data)
    changed[place] ^= 0xFF
    return bytes(changed)


def without_end(data):
    """What a kill leaves: everything up to the end of the last chunk."""
    return data[: chunk_spans(data)[-1][2]]


def without_checksums(data):
    """The file as a program writes it that computes none."""
    places = {
        damage.CHUNK: slice(24, 28),
        damage.ATTACHMENT: slice(-4, None),
        damage.DATA_END: slice(0, 4),
        damage.FOOTER: slice(16, 20),
    }
    changed = []
    for kind, content in damage.records(data[len(damage.MAGIC) :]):
        content = bytearray(content)
        if kind in places:
            content[places[kind]] = bytes(4)
        changed.append((kind, bytes(content)))
    return damage.MAGIC + damage.joined(changed) + damage.MAGIC


def rebuilt(data, change):
    """The file with other records, their lengths right, checksums and places not."""
    records = change(list(damage.records(data[len(damage.MAGIC) :])))
    return damage.MAGIC + damage.joined(records) + damage.MAGIC


# --- chunks ---------------------------------------------------------------------------


def test_a_chunk_holds_two_seconds_of_flight_or_so(flight, tmp_path):
    data, _ = flight
    counts = []
    for kind, content in damage.records(data[len(damage.MAGIC) :]):
        if kind == damage.CHUNK:
            messages = [c for k, c in damage.inside(content) if k == damage.MESSAGE]
            counts.append(sum(message[:2] == b"\1\0" for message in messages))
    assert sum(counts) == STEPS
    assert max(counts) <= MOST_OF_A_CHUNK
    assert min(counts[:-1]) >= 20


def test_a_chunk_of_short_steps_is_worth_its_index_entries(tmp_path):
    path = tmp_path / "run.mcap"
    rng = np.random.default_rng(0)
    step = runs.make_step(0, rng, horizon=1, qp=False)
    system = RecordedSystem(runs.STATES, runs.INPUTS, time_step=10.0)
    with McapRecorder(path, system) as recorder:
        for k in range(40):
            recorder.record(replace(step, k=k, time=10.0 * k))
    chunks = chunk_spans(path.read_bytes())
    numbers = 8 * (5 * 6 + 3 + 36 - 6 + 3 + 12 + 72)  # of a step [bytes]
    assert len(chunks) == -(-40 * numbers // (_recorder._SMALLEST_CHUNK + numbers - 1))


@pytest.mark.parametrize("end", ["finished", "killed"])
def test_a_spoiled_byte_costs_one_chunk_at_most(flight, tmp_path, end):
    data, steps = flight
    chunks = chunk_spans(data)
    first = chunks[0][1]
    data = data if end == "finished" else without_end(data)
    rng = np.random.default_rng(0)
    for place in rng.integers(first, chunks[-1][2], 15):
        run = read(spoiled(data, place), tmp_path)
        assert not run.finished
        assert is_right(run, steps)
        lost = STEPS - len(run.times)
        assert lost <= MOST_OF_A_CHUNK
        is_last = place >= chunks[-1][1]
        if end == "finished" or not is_last:
            assert run.lost_steps == lost
        assert run.lost_chunks == (lost > 0)


def test_lost_steps_are_counted_and_their_places_named(flight, tmp_path):
    data, _ = flight
    chunks = chunk_spans(data)
    firsts = Counter()
    whole = read(data, tmp_path)
    for row in (0, 3, len(chunks) - 1):
        run = read(spoiled(data, chunks[row][1] + 200), tmp_path)
        [lost] = [flaw for flaw in run.flaws if flaw.kind == "lost steps"]
        missing = sorted({*whole.steps} - {*run.steps})
        assert lost.count == len(missing) == STEPS - len(run.times)
        place = {
            0: f"before step {missing[-1] + 1}",
            3: f"between steps {missing[0] - 1} and {missing[-1] + 1}",
            len(chunks) - 1: f"after step {missing[0] - 1}",
        }[row]
        assert lost.text == f"{lost.count} of 200 steps are lost: {place}"
        [chunk] = [flaw for flaw in run.flaws if flaw.kind == "lost chunks"]
        assert chunk.text == (
            f"1 of {len(chunks)} chunks cannot be read, at byte {chunks[row][1]}"
        )
        firsts[missing[0]] += 1
    assert len(firsts) == 3


def test_a_killed_run_whose_first_chunk_is_lost_keeps_the_others(flight, tmp_path):
    data, steps = flight
    data = without_end(data)
    run = read(spoiled(data, chunk_spans(data)[0][1] + 500), tmp_path)
    assert is_right(run, steps)
    assert run.steps.tolist() == list(range(int(run.steps[0]), STEPS))
    assert set(kinds(run)) == {"lost chunks", "unfinished", "lost steps"}
    assert "of at least 200 steps are lost: before step" in run.flaws[-1].text
    recovered = recover(run.path, tmp_path / "recovered.mcap")
    np.testing.assert_array_equal(recovered.states, run.states)


@pytest.mark.parametrize("index", ["with an index", "without one"])
def test_a_chunk_whose_head_alone_is_damaged_is_read(small, tmp_path, index):
    data, steps = small
    _, start, _ = chunk_spans(data)[1]
    if index == "without one":
        data = without_end(data)
    for byte in range(9):
        for bit in range(8):
            changed = bytearray(data)
            changed[start + byte] ^= 1 << bit
            run = read(bytes(changed), tmp_path)
            assert run.steps.tolist() == list(range(20)), (byte, bit)
            assert is_right(run, steps)
            assert "damaged records" in kinds(run)


def test_bytes_put_in_or_taken_out_cost_no_more_than_a_chunk(small, tmp_path):
    data, steps = small
    rng = np.random.default_rng(0)
    chunks = chunk_spans(data)
    for _ in range(40):
        place = int(rng.integers(chunks[0][1], chunks[-1][2]))
        count = int(rng.integers(1, 200))
        inserted = data[:place] + rng.bytes(count) + data[place:]
        removed = data[:place] + data[place + count :]
        for changed in (inserted, removed):
            run = read(changed, tmp_path)
            assert is_right(run, steps)
            assert len(run.times) >= 10
            assert not run.whole


def test_a_chunk_that_comes_twice_is_read_once(small, tmp_path):
    data, steps = small

    def twice(records):
        rows = [i for i, (kind, _) in enumerate(records) if kind == damage.CHUNK]
        return [*records[: rows[1]], records[rows[0]], *records[rows[1] :]]

    run = read(rebuilt(data, twice), tmp_path)
    assert run.steps.tolist() == list(range(20))
    assert is_right(run, steps)
    assert any("come twice" in flaw.text for flaw in run.flaws)


def test_nothing_is_wrong_with_an_intact_recording(small, tmp_path):
    run = read(small[0], tmp_path)
    assert run.finished
    assert run.whole
    assert run.flaws == ()
    assert (run.lost_steps, run.lost_chunks) == (0, 0)


def test_a_recording_of_which_no_step_is_left_is_refused(small, tmp_path):
    data, _ = small
    for _, start, _ in chunk_spans(data):
        data = spoiled(data, start + 200)
    path = tmp_path / "gone.mcap"
    output = tmp_path / "recovered.mcap"
    path.write_bytes(data)
    message = r"gone\.mcap: no step of it can be read: 4 of 4 chunks cannot be read"
    with pytest.raises(RecordingError, match=message):
        read_run(path)
    with pytest.raises(RecordingError, match=message):
        recover(path, output)
    assert not output.exists()


def test_what_is_recovered_says_what_it_lost(small, tmp_path):
    data, steps = small
    path = tmp_path / "damaged.mcap"
    output = tmp_path / "recovered.mcap"
    path.write_bytes(spoiled(data, chunk_spans(data)[1][1] + 200))
    assert recover(path, output).path == output
    run = read_run(output)
    assert is_right(run, steps)
    assert (run.lost_steps, run.finished) == (5, False)
    assert "1 of 4 chunks cannot be read" in run.metadata["recovered"]["flaws"]
    assert "1 of 4 chunks cannot be read" in run.flaws[-1].text
    again = recover(output, tmp_path / "again.mcap")
    assert again.metadata == run.metadata


def test_what_is_recovered_twice_says_both_losses(small, tmp_path, monkeypatch):
    monkeypatch.setattr(_recovery, "Writer", partial(Writer, chunk_size=20_000))
    data, steps = small
    killed, first, second = (tmp_path / f"{name}.mcap" for name in "abc")
    killed.write_bytes(data[: chunk_spans(data)[3][1] + 200])  # in its last chunk
    recover(killed, first)
    whole = first.read_bytes()
    first.write_bytes(spoiled(whole, chunk_spans(whole)[0][1] + 200))
    lost = read_run(first).lost_steps
    run = recover(first, second)
    assert is_right(run, steps)
    assert 0 < lost == run.lost_steps == run.steps[-1] + 1 - len(run.steps)
    reasons = run.metadata["recovered"]["flaws"]
    assert "it has no end" in reasons
    assert "chunks cannot be read" in reasons


def test_data_are_whole_where_only_the_index_is_damaged(small, tmp_path):
    data, steps = small
    [end] = [stop for kind, _, stop in damage._spans(data) if kind == damage.DATA_END]
    for place in np.random.default_rng(0).integers(end, len(data), 20):
        run = read(spoiled(data, place), tmp_path)
        assert not run.finished
        assert not run.whole
        assert run.steps.tolist() == list(range(20))
        assert is_right(run, steps)


def test_an_index_vouches_for_channels_that_damage_hides(small, tmp_path):
    data, steps = small

    def without_topics(records):  # as in files of earlier versions
        return [
            f for f in records if not (f[0] == damage.METADATA and b"/step" in f[1])
        ]

    data = rebuilt(data, without_topics)
    first = chunk_spans(data)[0]
    with pytest.raises(RecordingError, match="135 messages are of no known channel"):
        read(spoiled(without_end(data), first[1] + 200), tmp_path)
    run = read(spoiled(small[0], first[1] + 200), tmp_path)
    assert run.steps.tolist() == list(range(5, 20))
    assert is_right(run, steps)


def test_older_files_are_read_and_their_losses_counted(small, tmp_path):
    data, steps = small

    def renumbered(content):  # from 0 on
        kind, body = content
        if kind != damage.MESSAGE:
            return content
        number = struct.unpack_from("<I", body, 2)[0]
        return kind, body[:2] + struct.pack("<I", number - 1) + body[6:]

    records = [
        damage.chunk(damage.joined(map(renumbered, damage.inside(content))))
        if kind == damage.CHUNK
        else (kind, content)
        for kind, content in damage.section(data)
        if kind != 7 and not (kind == damage.METADATA and b"/step" in content)
    ]
    run = read(damage.sealed(records), tmp_path)
    assert run.finished
    assert is_right(run, steps)
    rows = [i for i, (kind, _) in enumerate(records) if kind == damage.CHUNK]
    del records[rows[2]]
    run = read(damage.sealed(records), tmp_path)
    assert run.lost_steps == 5
    assert "between steps 9 and 15" in run.flaws[-1].text


# --- without checksums ----------------------------------------------------------------


def test_a_file_without_checksums_says_so(small, tmp_path):
    data, steps = small
    run = read(without_checksums(data), tmp_path)
    assert kinds(run) == ["no checksums"]
    assert run.flaws[0].text == ("no checksums: 180 messages may be altered unnoticed")
    assert not run.finished
    assert run.whole
    assert is_right(run, steps)
    recovered = recover(run.path, tmp_path / "recovered.mcap")
    assert not recovered.finished  # what is written now is not what was recorded
    assert "no checksums" in recovered.flaws[-1].text


def test_metadata_without_a_checksum_are_named(small, tmp_path):
    records = list(damage.records(small[0][len(damage.MAGIC) :]))
    changed = [
        (kind, bytes(4) if kind == damage.DATA_END else content)
        for kind, content in records
    ]
    run = read(damage.MAGIC + damage.joined(changed) + damage.MAGIC, tmp_path)
    assert kinds(run) == ["no checksums"]
    assert "no checksums of its metadata" in run.flaws[0].text


def with_statistics(place, code, number):
    def change(records):
        changed = []
        for kind, content in records:
            if kind == 11:  # statistics
                content = bytearray(content)
                struct.pack_into(code, content, place, number)
            changed.append((kind, bytes(content)))
        return changed

    return change


def removed(opcode, row=0):
    def change(records):
        rows = [i for i, (kind, _) in enumerate(records) if kind == opcode]
        return [*records[: rows[row]], *records[rows[row] + 1 :]]

    return change


def swapped(records):
    rows = [i for i, (kind, _) in enumerate(records) if kind == damage.CHUNK]
    records[rows[1]], records[rows[2]] = records[rows[2]], records[rows[1]]
    return records


def with_steps(records, count):
    return [
        damage.metadata("end", {"steps": str(count), "outcome": "complete"})
        if kind == damage.METADATA and b"outcome" in content
        else (kind, content)
        for kind, content in records
    ]


def without_summary(records):
    end = [kind for kind, _ in records].index(damage.DATA_END)
    return [*records[: end + 1], (damage.FOOTER, bytes(20))]


ALTERED = {
    "a chunk is lost": (removed(damage.CHUNK, 1), "lost steps"),
    "chunks change places": (swapped, "wrong order"),
    "the metadata of the end are lost": (removed(damage.METADATA, -1), "damaged index"),
    "other metadata are lost": (removed(damage.METADATA, 2), "damaged index"),
    "the settings are lost": (removed(damage.ATTACHMENT), "damaged index"),
    "attachments are counted otherwise": (with_statistics(14, "<I", 0), "wrong count"),
    "metadata are counted otherwise": (with_statistics(18, "<I", 9), "wrong count"),
    "the end counts more steps": (
        lambda records: with_steps(records, 30),
        "lost steps",
    ),
    "the end counts fewer steps": (
        lambda records: with_steps(records, 3),
        "wrong count",
    ),
    "messages are counted otherwise": (with_statistics(0, "<Q", 181), "wrong count"),
    "schemas are counted otherwise": (with_statistics(8, "<H", 6), "wrong count"),
    "channels are counted otherwise": (with_statistics(10, "<I", 8), "wrong count"),
    "chunks are counted otherwise": (with_statistics(22, "<I", 3), "wrong count"),
    "a topic is counted otherwise": (with_statistics(48, "<Q", 19), "wrong count"),
    "an entry of a chunk is lost": (removed(8), "damaged index"),
    "an entry of metadata is lost": (removed(13), "damaged index"),
    "a schema is not repeated": (removed(damage.SCHEMA), "damaged index"),
    "the data have no end": (removed(damage.DATA_END), "unfinished"),
    "a chunk is lost with the index": (
        lambda records: without_summary(removed(damage.CHUNK, 1)(records)),
        "lost steps",
    ),
}


@pytest.mark.parametrize("case", ALTERED)
def test_a_file_without_checksums_names_its_altered_structure(small, tmp_path, case):
    change, kind = ALTERED[case]
    run = read(rebuilt(without_checksums(small[0]), change), tmp_path)
    assert not run.finished
    assert not run.whole
    assert {kind, "no checksums"} <= {*kinds(run)}, run.flaws


def test_names_that_differ_from_the_schema_are_named(small, tmp_path):
    data = without_checksums(small[0]).replace(b"x vx y vy z vz", b"x vx y vy z wz")
    run = read(data, tmp_path)
    assert run.state_names == runs.STATES
    assert any("name other states" in flaw.text for flaw in run.flaws)


# --- many mutations -------------------------------------------------------------------


def chunks_moved(data, rng):
    """A chunk removed, repeated or exchanged with another."""

    def change(records):
        rows = [i for i, (kind, _) in enumerate(records) if kind == damage.CHUNK]
        i, j = (int(row) for row in rng.permutation(rows)[:2])
        kind = rng.integers(3)
        if kind == 0:
            del records[i]
        elif kind == 1:
            records.insert(j, records[i])
        else:
            records[i], records[j] = records[j], records[i]
        return records

    return rebuilt(data, change)


def zeroed(data, rng):
    start = int(rng.integers(len(data)))
    length = min(int(rng.choice([16, 512, 4096, 20_000])), len(data) - start)
    return data[:start] + bytes(length) + data[start + length :]


def one_byte(data, rng):
    return spoiled(data, int(rng.integers(len(data))))


MUTATIONS = (*damage.DAMAGES, chunks_moved, zeroed, one_byte, one_byte)


def attempt(path):
    """The run in a file, or the line that refuses it."""
    try:
        return read_run(path)
    except RecordingError as error:
        return str(error)


def check_mutations(data, steps, folder, first, count, has_checksums=True):
    """Damages a file in many ways, and judges each by what was recorded."""
    path = folder / "mutated.mcap"
    path.write_bytes(data)
    original = read_run(path)
    mutations = [
        mutation
        for mutation in MUTATIONS
        if original.whole or mutation is not damage.flip_end
    ]
    outcomes = Counter()
    for i in range(first, first + count):
        mutation = mutations[i % len(mutations)]
        path.write_bytes(mutation(data, np.random.default_rng([36, i])))
        case = (mutation.__name__, i)
        began = time.process_time()
        run = attempt(path)
        assert time.process_time() - began < 5, case
        if isinstance(run, str):
            assert path.name in run, case
            assert "\n" not in run, case
            outcomes["refused"] += 1
            continue
        outcomes["finished" if run.finished else "flawed"] += 1
        if run.finished:
            assert study.same(run, original), case
        if run.whole:
            assert len(run.times) == len(original.times), case
        if has_checksums:
            assert is_right(run, steps), case
            assert len({*run.steps}) == len(run.steps), case
        else:
            assert not run.finished, case
        if has_checksums and run.lost_steps and original.finished:
            has_end = "unfinished" not in kinds(run)
            lost = len(original.times) - len(run.times)
            assert run.lost_steps == lost or not has_end, case
    return outcomes


FORMS = {
    "finished": lambda data: data,
    "killed": without_end,
    "without checksums": without_checksums,
}


@pytest.mark.parametrize("form", FORMS)
def test_a_mutated_recording_is_refused_or_named(small, tmp_path, form):
    data, steps = small
    mutated = FORMS[form](data)
    has_checksums = form != "without checksums"
    outcomes = check_mutations(mutated, steps, tmp_path, 0, 75, has_checksums)
    assert outcomes["flawed"] > 50


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
def test_thousands_of_mutated_recordings_are_refused_or_named(small, tmp_path, form):
    data, steps = small
    mutated = FORMS[form](data)
    has_checksums = form != "without checksums"
    outcomes = check_mutations(mutated, steps, tmp_path, 1000, 3000, has_checksums)
    assert outcomes["flawed"] > 2000


# --- files that mean harm -------------------------------------------------------------


def marks(data):
    """A hundred thousand places that look like chunks of two megabytes."""
    mark = bytes(28) + damage.text("zstd") + struct.pack("<Q", 2 * 10**6)
    return data + b"\xff" * 9 + (mark + b"\x28\xb5\x2f\xfd") * 10**5


def bombs(data):
    """Chunks in broken frames that unfold to zeros, and have a wrong checksum."""
    size = 30 * 2**20
    packed = zstandard.compress(bytes(size))
    _, content = damage.chunk(b"", "zstd", size, crc=7, compressed=packed)
    return data + b"\xff" * 9 + (bytes(9) + content) * 1000


def entries(data):
    """An index of fifty thousand places where there is nothing."""
    body = data + b"\xfe" * 10**6 + struct.pack("<BQI", damage.DATA_END, 4, 0)
    index = b"".join(
        struct.pack("<BQQQI", 13, 20, len(data) + 11 * i, 9, 0) for i in range(50_000)
    )
    footer = struct.pack("<BQQQ", damage.FOOTER, 20, len(body), 0)
    checksum = struct.pack("<I", zlib.crc32(index + footer))
    return body + index + footer + checksum + damage.MAGIC


def topics(data):
    """Channels with numbers of thousands of digits."""
    pairs = {"9" * 5000: "/step", "\u0663": "/plan", "-1": "/qp", "70000": "/step"}
    return data + damage.joined([damage.metadata("channels", pairs)])


@pytest.mark.parametrize("harm", [marks, bombs, entries, topics])
def test_the_search_behind_damage_ends(small, tmp_path, harm):
    path = tmp_path / "harm.mcap"
    path.write_bytes(harm(damage.MAGIC + damage.joined(damage.section(small[0]))))
    began = time.process_time()
    run = attempt(path)
    if isinstance(run, str):
        assert re.search(r"harm\.mcap: its chunks unfold to more", run)
    else:
        assert not run.finished
    assert time.process_time() - began < 5
