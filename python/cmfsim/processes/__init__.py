"""Code run elsewhere: in a child with limits, in a pool of workers, on a cluster."""
