//! What the tests share: small scenes, temporary folders, running the command.
