"""What a long command tells while it works."""

import logging

from gpmpc.cli._terminal import logging_console


def test_log_messages_show_once_and_a_searchs_steps_never(capsys):
    log = logging.getLogger("gpmpc")
    before = log.handlers, log.propagate, log.level
    try:
        logging_console()
        for _ in range(2):
            logging.getLogger("gpmpc.gp._scaling").info("constant columns are centred")
        logging.getLogger("gpmpc.gp._search").info(
            "training: output 1 of 6: evaluation 3"
        )
    finally:
        log.handlers, log.propagate, log.level = before
    shown = capsys.readouterr().out
    assert shown.count("constant columns are centred") == 1
    assert "evaluation" not in shown
