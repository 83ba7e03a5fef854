"""`crkr bench`: measurements beside a bare baseline, in one run."""
