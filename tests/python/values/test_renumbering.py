"""What is left of a mesh once cells are dropped."""

import numpy as np
import pytest

from cmfsim.values.surface_data import used_nodes


@pytest.mark.parametrize(("width", "kind"), [(3, np.uint32), (4, np.uint32), (3, np.int64)])
def test_used_nodes_are_those_that_sorting_finds(width, kind):
    """Each node once, ascending, and cells that name the same ones."""
    cells = np.random.default_rng(5).integers(0, 40, (50, width)) * 3
    nodes, left = used_nodes(cells.astype(kind))
    expected, numbers = np.unique(cells, return_inverse=True)
    np.testing.assert_array_equal(nodes, expected)
    np.testing.assert_array_equal(left, numbers.reshape(cells.shape))
    np.testing.assert_array_equal(nodes[left], cells)


def test_no_cells_use_no_nodes():
    """An empty surface keeps its width."""
    nodes, left = used_nodes(np.zeros((0, 3), dtype=np.uint32))
    assert nodes.shape == (0,)
    assert left.shape == (0, 3)
