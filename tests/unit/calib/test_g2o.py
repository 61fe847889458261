"""The .g2o format: what is written is read, conventions are GTSAM's, torn files are refused by line."""

from pathlib import Path

import numpy as np
import pytest

from rig_calib.pose_graph.edge_batch import EdgeBatch
from rig_calib.pose_graph.g2o import PoseGraph, format_g2o, parse_g2o, read_g2o, write_g2o
from rig_protocol.errors import ConfigurationError, DataError
from support.pose_graphs import spiral

VERTICES = ["VERTEX_SE3:QUAT 4 1 2 3 0 0 0 1", "VERTEX_SE3:QUAT 7 0 0 0 0 0 0.6 0.8"]
EDGE = "EDGE_SE3:QUAT 4 7 1 0 0 0 0 0 1 " + " ".join(
    str(10.0 * (k + 1)) if k == j else "0.5" for k in range(6) for j in range(k, 6)
)


def test_what_is_written_is_read_to_the_last_digits(tmp_path: Path) -> None:
    graph, _ = spiral(30, per_turn=7)
    rng = np.random.default_rng(0)
    roots = np.tril(rng.standard_normal((len(graph.edges), 6, 6))) + 2 * np.eye(6)
    edges = EdgeBatch(graph.edges.i, graph.edges.j, graph.edges.T_i_j, roots @ roots.transpose(0, 2, 1))
    fixed = np.arange(30) % 11 == 3
    written = PoseGraph(tuple(range(100, 130)), graph.T, edges, fixed)
    write_g2o(tmp_path / "graph.g2o", written)
    read = read_g2o(tmp_path / "graph.g2o")
    assert read.ids == written.ids
    np.testing.assert_array_equal(read.fixed, fixed)
    np.testing.assert_array_equal(read.edges.i, edges.i)
    np.testing.assert_array_equal(read.edges.j, edges.j)
    np.testing.assert_allclose(read.T, written.T, atol=1e-14)
    np.testing.assert_allclose(read.edges.T_i_j, edges.T_i_j, atol=1e-14)
    np.testing.assert_allclose(read.edges.information, edges.information, rtol=1e-15)


def test_the_file_is_translation_first_and_holds_the_upper_triangle_by_rows() -> None:
    graph = parse_g2o([*VERTICES, EDGE])
    np.testing.assert_array_equal(np.diag(graph.edges.information[0]), [40, 50, 60, 10, 20, 30])
    assert (graph.edges.information[0] == graph.edges.information[0].T).all()
    uneven = EDGE.split()
    uneven[11] = "7"  # row 0, column 1: x and y of the translation
    uneven[14] = "9"  # row 0, column 4: x of the translation with the rotation about y
    information = parse_g2o([*VERTICES, " ".join(uneven)]).edges.information[0]
    assert information[3, 4] == 7
    assert information[3, 1] == 9


def test_poses_are_translation_then_quaternion_with_w_last() -> None:
    graph = parse_g2o([*VERTICES, EDGE])
    np.testing.assert_allclose(graph.T[0, :3, 3], [1, 2, 3])
    np.testing.assert_allclose(graph.T[1, :3, 0], [0.28, 0.96, 0])


def test_comments_parameters_and_empty_lines_are_passed_over_and_fix_is_read() -> None:
    lines = ["# a map", "", "PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1", *VERTICES, "FIX 7", EDGE]
    assert parse_g2o(lines).fixed.tolist() == [False, True]


@pytest.mark.parametrize(
    ("lines", "told"),
    [
        ([*VERTICES, EDGE.rsplit(" ", 1)[0]], "line 3: EDGE_SE3:QUAT has 29 values, not 30"),
        ([*VERTICES, EDGE.replace("0.5", "half", 1)], "line 3: could not convert string to float: 'half'"),
        ([*VERTICES, EDGE.replace("0.5", "nan", 1)], "line 3: EDGE_SE3:QUAT holds a number"),
        ([*VERTICES, EDGE.replace("0.5", "1e300", 1)], "line 3: EDGE_SE3:QUAT holds a number"),
        ([*VERTICES, EDGE.replace("10.0", "-1", 1)], "line 3: the information matrix is not positive"),
        ([*VERTICES, EDGE.replace(" 4 7 ", " 4 8 ")], "line 3: the edge 4 8 names vertex 8"),
        ([*VERTICES, EDGE.replace(" 4 7 ", " 4 4 ")], "line 3: the edge joins vertex 4 to itself"),
        ([*VERTICES, EDGE.replace(" 4 7 ", f" 4 {2**70} ")], "line 3: a vertex id has more than 62 bits"),
        ([*VERTICES, EDGE.replace("QUAT 4", "QUAT 4.5")], "line 3: invalid literal for int"),
        ([VERTICES[0], VERTICES[0], EDGE], "line 2: vertex 4 stands in the file twice"),
        (
            [VERTICES[0].replace("0 0 0 1", "0 0 0 2"), VERTICES[1], EDGE],
            "line 1: the quaternion's norm is 2",
        ),
        ([*VERTICES, EDGE, "FIX 5"], "line 4: FIX names vertex 5"),
        (["EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1"], "line 1: 'EDGE_SE2' is none of"),
        ([], "no line VERTEX_SE3:QUAT"),
        (VERTICES, "no line EDGE_SE3:QUAT"),
    ],
)
def test_a_line_that_does_not_fit_is_named(lines: list[str], told: str) -> None:
    with pytest.raises(DataError, match="^" + told.replace("(", r"\(")):
        parse_g2o(lines)


def test_an_absent_file_and_one_of_other_bytes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"absent\.g2o"):
        read_g2o(tmp_path / "absent.g2o")
    (tmp_path / "picture.g2o").write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(DataError, match="no text"):
        read_g2o(tmp_path / "picture.g2o")


def test_lines_come_in_the_order_of_the_format() -> None:
    tags = [line.split()[0] for line in format_g2o(parse_g2o([*VERTICES, "FIX 4", EDGE]))]
    assert tags == ["VERTEX_SE3:QUAT", "VERTEX_SE3:QUAT", "FIX", "EDGE_SE3:QUAT"]
