"""From a clip, and from what other tools wrote about it, to a data folder."""
