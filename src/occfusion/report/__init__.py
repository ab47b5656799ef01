"""Tables and the page of one run."""
