"""Boxes that a second opinion adds to a teacher's."""

import numpy as np

from models.training.scenes import SURE
from models.training.second_opinion import Opinion, added

TEACHER = [[100.0, 100.0, 150.0, 240.0, 0.9], [300.0, 100.0, 350.0, 240.0, 0.4]]


def opinion(*box: float, product: float = 0.6) -> Opinion:
    return Opinion(np.array(box), product)


def test_the_teacher_s_boxes_stay_and_one_that_is_confirmed_becomes_sure() -> None:
    again = [opinion(102, 101, 149, 238), opinion(303, 98, 352, 239)]
    people = added(TEACHER, again)
    assert [person[:4] for person in people] == [person[:4] for person in TEACHER]
    assert people[0][4] == 0.9
    assert people[1][4] >= SURE
    assert TEACHER[1][4] == 0.4


def test_somebody_new_is_sure_only_where_both_are_very_sure() -> None:
    people = added(TEACHER, [opinion(500, 90, 560, 260), opinion(600, 90, 660, 260, product=0.3)])
    assert [person[4] >= SURE for person in people[2:]] == [True, False]


def test_parts_of_people_and_boxes_around_two_are_not_people() -> None:
    halves = [opinion(102, 102, 148, 165), opinion(95, 95, 355, 245)]
    assert added(TEACHER, halves) == TEACHER
    leg = added(TEACHER, [opinion(120, 180, 170, 250)])
    assert leg[2][4] < SURE


def test_of_two_opinions_about_one_person_the_better_stays() -> None:
    people = added([], [opinion(10, 10, 60, 150), opinion(12, 12, 62, 152, product=0.5)])
    assert len(people) == 1
    assert people[0][:4] == [10, 10, 60, 150]
