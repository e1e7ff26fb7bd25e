"""The benchmark of judging times what a flight's judge is asked."""

from benchmarks import judgement


def test_judging_is_timed_beside_deciding(monkeypatch, capsys):
    overrides = ("trajectory=hover", "data.size=25", "steps=4", "horizon=5")
    monkeypatch.setattr(judgement, "COSTS", {"a short hover": overrides})
    judgement.cost()
    printed = capsys.readouterr().out
    assert "a short hover" in printed
    assert "%" in printed
