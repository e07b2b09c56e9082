//! The words that server, worker and command line share. No I/O.
