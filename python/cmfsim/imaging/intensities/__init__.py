"""The intensities of a scan: levels of air, tissue and bone, noise, what kind of image it is."""
