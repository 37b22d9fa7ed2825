"""The study: the stages that fly, in one process, without a network; ``hvt-study`` is its door."""
