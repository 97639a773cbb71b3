"""A run's episodes at a glance: listed, filtered and labelled.

The answers come from ``catalogue.sqlite`` in the run folder, a cache that is brought up to date
before each answer: one look at the folder, and only files that changed are opened.
"""

from bridge.episode.catalogue.entry import Entry as Entry
from bridge.episode.catalogue.find import find_episodes as find_episodes
from bridge.episode.catalogue.labels import outcome_of as outcome_of
from bridge.episode.catalogue.listing import label_episode as label_episode
from bridge.episode.catalogue.listing import list_episodes as list_episodes
from bridge.episode.catalogue.listing import note_finished as note_finished
