"""What a model was trained to hear: its sentences and contents, whether it knows a prompt, and the body parts of one.

Knows sentences, their embeddings and body parts; knows no motion, no network and no timeline.
"""

from stmc.vocabulary.building import build_vocabulary
from stmc.vocabulary.files import VocabularyError, read_vocabulary, write_vocabulary
from stmc.vocabulary.recogniser import Recogniser
from stmc.vocabulary.sentences import Content, Sentence, embed_sentences, sentence_encoder
from stmc.vocabulary.suggestion import Suggestion, suggest
from stmc.vocabulary.vocabulary import Recognition, Vocabulary

__all__ = [
    "Content",
    "Recogniser",
    "Recognition",
    "Sentence",
    "Suggestion",
    "Vocabulary",
    "VocabularyError",
    "build_vocabulary",
    "embed_sentences",
    "read_vocabulary",
    "sentence_encoder",
    "suggest",
    "write_vocabulary",
]
