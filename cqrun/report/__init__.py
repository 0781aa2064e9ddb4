"""Reports: one self-contained page (HTML) about a run, about several runs, or about a study of many."""
