"""`cqrun export RUN --to TRACKER`: a finished run in the folders of other programs that compare runs."""
