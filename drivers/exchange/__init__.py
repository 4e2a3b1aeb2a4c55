"""The exchange: replying to a controller's packets, in this process or in one of its own."""
