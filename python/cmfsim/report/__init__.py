"""Reports of results: one self-contained page for a case or a study, on screen and on paper."""
