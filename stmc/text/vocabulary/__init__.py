"""The vocabulary of a model: its training sentences and actions, in-vocabulary tests, success rates, and body parts.

Depends on sentences, their embeddings and body parts; independent of motions, networks and timelines.
"""

from stmc.text.vocabulary.building import build_vocabulary
from stmc.text.vocabulary.calibration import RARELY, SHOWN_RATE, Calibration, Trial
from stmc.text.vocabulary.calibration_files import read_calibration, write_calibration
from stmc.text.vocabulary.recogniser import Recogniser
from stmc.text.vocabulary.sentences import Content, Sentence, embed_sentences, sentence_encoder
from stmc.text.vocabulary.suggestion import Suggestion, suggest
from stmc.text.vocabulary.vocabulary import Recognition, Vocabulary
from stmc.text.vocabulary.vocabulary_files import VocabularyError, read_vocabulary, write_vocabulary

__all__ = [
    "RARELY",
    "SHOWN_RATE",
    "Calibration",
    "Content",
    "Recogniser",
    "Recognition",
    "Sentence",
    "Suggestion",
    "Trial",
    "Vocabulary",
    "VocabularyError",
    "build_vocabulary",
    "embed_sentences",
    "read_calibration",
    "read_vocabulary",
    "sentence_encoder",
    "suggest",
    "write_calibration",
    "write_vocabulary",
]
