"""A library that takes processor time to start, once: for `test_child.py`."""

import os
import time

if os.environ.get("CMFSIM_SLOW_LIBRARY"):
    while time.process_time() < 3.5:
        pass
