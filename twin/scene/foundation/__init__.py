"""Adapters to large pretrained models: weights from a local folder, never from the network.

SAM 3 gives masks, CLIP vectors of words and things. None is needed for a scene;
``docs/foundation_models.md`` says how to get them.
"""
