import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from python_process import printed

from articugen.core.seeding import generator

paths = st.lists(st.one_of(st.integers(0, 10**9), st.text(max_size=8)), max_size=4).map(tuple)


@given(st.integers(), paths)
def test_the_same_path_gives_the_same_numbers(seed, path) -> None:
    np.testing.assert_array_equal(
        generator(seed, *path).random(4), generator(seed, *path).random(4)
    )


@given(st.integers(), st.integers(), paths, paths)
def test_another_seed_or_path_gives_other_numbers(seed, other_seed, path, other_path) -> None:
    same = (seed, path) == (other_seed, other_path)
    numbers, others = generator(seed, *path).random(4), generator(other_seed, *other_path).random(4)
    assert np.array_equal(numbers, others) == same


def test_a_path_is_more_than_its_text_run_together() -> None:
    runs = [("ab", "c"), ("a", "bc"), ("abc",), ("a", 1), ("a", "1"), ("a1",), ()]
    first = {generator(0, *path).random() for path in runs}
    assert len(first) == len(runs)


def test_another_process_draws_the_same() -> None:
    code = (
        "from articugen.core.seeding import generator\n"
        "print(generator(0, 'lamp', 3).random().hex())"
    )
    assert printed("-c", code, PYTHONHASHSEED="1").strip() == generator(0, "lamp", 3).random().hex()


def test_the_numbers_stay_what_they_were_when_published() -> None:
    """Data sets are remade from their seed: these values must never move."""
    drawn = generator(0, "laptop-000", 1, "surface").integers(0, 2**32, 3)
    assert drawn.tolist() == [1001698677, 3192982516, 711102695]


def test_numpy_integers_are_integers() -> None:
    assert generator(np.int64(3), np.int32(4)).random() == generator(3, 4).random()
