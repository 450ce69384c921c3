"""One file a command; ``cli`` joins them. Commands hold no logic and import it when called."""
