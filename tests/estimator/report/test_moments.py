"""Which answers are drawn."""

from estimator.report.recordings import recording, status
from softtissue_estimator.report.moments import choose
from softtissue_estimator.report.recorded import Answer


def sure(time_s, *sigmas, **changes):
    return status(time_s, sigmas=tuple((str(n), sigma) for n, sigma in enumerate(sigmas)), **changes)


def chosen(*arguments):
    return [(moment.answer.time_s, moment.why) for moment in choose(*arguments)]


def test_first_last_and_least_sure_answer_are_drawn_in_their_order():
    told = recording([sure(1.0, 0.001), sure(2.0, 0.002, 0.009), sure(3.0, 0.005), sure(4.0, 0.001)])
    assert chosen(told) == [(1.0, "first answer"), (2.0, "largest standard deviation"), (4.0, "last answer")]


def test_answer_that_is_several_of_them_is_drawn_once():
    assert chosen(recording([sure(1.0, 0.003)])) == [
        (1.0, "first answer, last answer, largest standard deviation")
    ]


def test_estimator_without_a_standard_deviation_has_no_least_sure_answer():
    assert chosen(recording([sure(1.0, float("nan")), sure(2.0)])) == [
        (1.0, "first answer"),
        (2.0, "last answer"),
    ]


def test_least_sure_one_is_an_answer_that_was_recorded():
    told = recording([sure(1.0, 0.001), sure(2.0, 0.9), sure(3.0, 0.002)], answers=(Answer(1.0, 2 * 10**9),))
    assert [time for time, _ in chosen(told)] == [1.0]


def test_stamp_that_comes_again_is_the_answer_of_its_time():
    told = recording([sure(1.0, 0.001, stamp_ns=5), sure(9.0, 0.004, stamp_ns=5), sure(10.0, 0.001)])
    assert (9.0, "largest standard deviation") in chosen(told)


def test_given_times_have_the_nearest_answers():
    told = recording([sure(float(n)) for n in range(10)])
    assert chosen(told, [7.6, -5.0, 2.2]) == [
        (0.0, "nearest to -5 s"),
        (2.0, "nearest to 2.2 s"),
        (8.0, "nearest to 7.6 s"),
    ]


def test_nothing_is_drawn_where_nothing_was_answered():
    assert choose(recording([status(0.0, "INVALID", "no organ")]), [1.0]) == []
