"""The exchange: answering a controller's packets, in this process or in one of its own."""
