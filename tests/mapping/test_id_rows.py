"""Rows by id."""

import numpy as np

from stereo_sfm.mapping.columns import IdRows


def test_ids_are_found_as_in_a_dictionary() -> None:
    rng = np.random.default_rng(0)
    table, expected, ids = IdRows(), dict[int, int](), rng.permutation(10_000)[:900]
    assert (table.find(ids) == -1).all()
    for part in np.split(ids, 30):
        rows = rng.integers(0, 500, len(part))
        table.add(part, rows)
        expected.update(zip(part.tolist(), rows.tolist(), strict=True))
        asked = np.append(rng.integers(-5, 10_005, 50), part)
        assert table.find(asked).tolist() == [expected.get(k, -1) for k in asked.tolist()]
        known = rng.random(len(table.ids)) < 0.9
        for gone in table.ids[~known].tolist():
            del expected[gone]
        table.keep(known)
        assert len(table.ids) == len(expected) and table.ids.nbytes + table.rows.nbytes == 12 * len(expected)
