"""The process that starts workers, hands out trials and notices what is lost."""
