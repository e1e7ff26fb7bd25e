"""Studies: conditions and seeds, their trials, the store of records, and the tables.

    flight    one trial: an experiment is flown, measured and summed up in words
    study     trials of all conditions and seeds, and the store of their records
    tuning    a search for the settings of least cost
    report    a tree of runs as one table with figures, and whether two groups differ

Below them, ``_run_folder`` keeps a run of ``gpmpc run`` on the disk, ``_runs`` reads a
tree of them, and ``_document`` writes any result as Markdown, CSV, LaTeX and HTML.
"""
