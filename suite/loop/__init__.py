"""The loop: train, fly, record, fit the Delta Action Model, fine-tune, fly again."""
