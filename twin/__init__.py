"""Rebuild a scene from recorded episodes, and replay plans and executions in it."""
