"""Who learns, and how: the network, what it sees, the Taylor loss, the fit, its exports."""
