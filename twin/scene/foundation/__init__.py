"""Adapters to large pretrained models: weights from a local folder, never from the network.

SAM 3 gives masks, DINOv3 feature maps, CLIP embeddings, Depth Anything distances, SAM 3D Objects
whole shapes. None is needed for a scene; ``docs/foundation_models.md`` says how to get them.
"""
