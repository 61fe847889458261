"""The reader of .g2o files against any lines."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from rig_calib.pose_graph.g2o import parse_g2o
from rig_calib.pose_graph.solution import solve
from rig_protocol.errors import DataError

WORDS = st.one_of(
    st.sampled_from(["VERTEX_SE3:QUAT", "EDGE_SE3:QUAT", "FIX", "#", "nan", "1e9", "-1", "0", "1"]),
    st.text(max_size=6),
    st.floats().map(repr),
)
VERTEX = st.tuples(st.integers(0, 3), st.lists(st.floats(-1e3, 1e3), min_size=3, max_size=3)).map(
    lambda v: f"VERTEX_SE3:QUAT {v[0]} {' '.join(map(repr, v[1]))} 0 0 0 1"
)
EDGE = st.tuples(st.integers(0, 3), st.integers(0, 3), st.lists(st.floats(-1e3, 1e3), min_size=27)).map(
    lambda e: f"EDGE_SE3:QUAT {e[0]} {e[1]} " + " ".join(map(repr, [*e[2][:3], 0, 0, 0, 1, *e[2][6:27]]))
)


@given(st.lists(st.one_of(VERTEX, EDGE, st.lists(WORDS, max_size=32).map(" ".join)), max_size=8))
@settings(max_examples=100, deadline=None)
def test_any_lines_are_a_graph_or_a_data_error(lines: list[str]) -> None:
    try:
        graph = parse_g2o(lines)
    except DataError:
        return
    assert len(graph.ids) == len(graph.T) > 0
    assert np.isfinite(graph.edges.information).all()


DIAGONAL = st.lists(st.floats(1e-6, 1e9), min_size=6, max_size=6)


@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4), DIAGONAL), min_size=1, max_size=8))
@settings(max_examples=40, deadline=None)
def test_any_small_graph_that_is_read_is_solved(edges: list[tuple[int, int, list[float]]]) -> None:
    lines = [f"VERTEX_SE3:QUAT {k} {k} 0 0 0 0 0 1" for k in range(5)]
    for k, (i, j, diagonal) in enumerate(edges):
        upper = [repr(diagonal[a]) if a == b else "0" for a in range(6) for b in range(a, 6)]
        if i != j:
            lines.append(f"EDGE_SE3:QUAT {i} {j} {k} 1 0 0 0 0.6 0.8 {' '.join(upper)}")
    if len(lines) > 5:
        graph = parse_g2o(lines)
        for robust in (False, True):
            solution = solve(graph, robust)
            assert solution.after["chordal"] >= 0.0
