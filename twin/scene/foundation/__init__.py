"""Adapters to large pretrained models: weights from a local folder, never from the network.

SAM 3 gives masks, DINOv3 feature maps, CLIP embeddings. None is needed for a scene;
``docs/foundation_models.md`` says how to get them.
"""
