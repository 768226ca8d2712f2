"""Planning from the face: the bone movements whose predicted face is closest to a desired one."""
