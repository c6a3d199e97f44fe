"""What travels: topics, message types, codec, transports, the log."""
