"""Messages and connections: wire codecs, robot link, ZeroMQ bus, request/reply, authentication, clients.

The codecs are pure; the others move bytes and decide nothing.
"""
