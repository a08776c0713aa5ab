"""Perceptual studies (STMC, sections 4.2 and 4.4): survey pages and the analysis of answers.

A page shows motions of one timeline by two methods side by side. This package knows motions, timelines and answers; it
knows no model and cannot generate motions.
"""

from stmc.evaluation.study.analysis import Analysis, Preference, Vote, analyse, wilson
from stmc.evaluation.study.answers import Answers, AnswersError, read_answers
from stmc.evaluation.study.comparisons import Pair, read_pairs
from stmc.evaluation.study.key import Aspect, Key, Kind, StudyError
from stmc.evaluation.study.pages import survey_page
from stmc.evaluation.study.surveys import Question, Survey, design

__all__ = [
    "Analysis",
    "Answers",
    "AnswersError",
    "Aspect",
    "Key",
    "Kind",
    "Pair",
    "Preference",
    "Question",
    "StudyError",
    "Survey",
    "Vote",
    "analyse",
    "design",
    "read_answers",
    "read_pairs",
    "survey_page",
    "wilson",
]
