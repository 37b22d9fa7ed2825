"""Stages of edge and ground put together without a link, and the messages between them."""
