"""The paper's experiment: open loop against RCP, max angle against contact angle, with controls."""
