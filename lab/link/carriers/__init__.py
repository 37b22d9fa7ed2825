"""Players of a script between two processes: a relay, two network namespaces, or a tunnel."""
