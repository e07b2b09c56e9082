//! Pieces: runs of a stream's grids that any thread can decode, and the bounded pipeline that shares work out in order.

use std::collections::BTreeMap;
use std::sync::{Condvar, Mutex, MutexGuard};

use super::{Microgrid, MicrogridStream};
use crate::Result;

/// Vertices that a piece should hold at least, where the source is free to choose: half a millisecond's work or more.
pub const PIECE_VERTICES: usize = 1 << 14;

/// Results that may wait for an earlier one, for every thread.
const WAITING_PER_THREAD: usize = 4;

/// A run of consecutive grids of a stream, ready to be decoded on any thread.
pub trait Piece: Send {
    /// Calls `each` with the run's grids in their order. `grid` is memory to decode into.
    ///
    /// # Errors
    /// As [`MicrogridStream::next`], and what `each` returns.
    fn read(
        self: Box<Self>,
        grid: &mut Microgrid,
        each: &mut dyn FnMut(&Microgrid) -> Result<()>,
    ) -> Result<()>;
}

/// Grids that are decoded already.
struct Decoded(Vec<Microgrid>);

impl Piece for Decoded {
    fn read(
        self: Box<Self>,
        _grid: &mut Microgrid,
        each: &mut dyn FnMut(&Microgrid) -> Result<()>,
    ) -> Result<()> {
        self.0.iter().try_for_each(each)
    }
}

/// The next piece of a stream that can only be read grid by grid.
pub(super) fn gather<S: MicrogridStream + ?Sized>(stream: &mut S) -> Result<Option<Box<dyn Piece>>> {
    let (mut grids, mut vertices) = (Vec::new(), 0);
    let mut grid = Microgrid::default();
    while vertices < PIECE_VERTICES && stream.next(&mut grid)? {
        vertices += grid.vertex_count();
        grids.push(std::mem::take(&mut grid));
    }
    Ok((!grids.is_empty()).then(|| Box::new(Decoded(grids)) as Box<dyn Piece>))
}

/// Does `work` on all that `next` hands out, on one thread for every state, and gives the results to `finish` one at a
/// time in the order of the work. The first error in that order ends it.
///
/// A thread that is far ahead waits, so that few results are held. `next` may wait for something that finishing a
/// result sets free.
///
/// # Errors
/// What the functions return.
pub fn in_order<T, R: Send, S: Send>(
    states: &mut [S],
    next: impl FnMut() -> Result<Option<T>> + Send,
    work: impl Fn(&mut S, T) -> Result<R> + Sync,
    finish: impl FnMut(R) -> Result<()> + Send,
) -> Result<()> {
    let line = Line {
        source: Mutex::new((0, next)),
        order: Mutex::new(Order { next: 0, waiting: BTreeMap::new(), is_finishing: false, failed: None }),
        moved: Condvar::new(),
        finish: Mutex::new(finish),
        waiting_max: WAITING_PER_THREAD * states.len(),
    };
    let walk = |state: &mut S| line.walk(|item| work(state, item));
    let (first, others) = states.split_first_mut().expect("at least one thread");
    std::thread::scope(|scope| {
        let handles: Vec<_> = others.iter_mut().map(|state| scope.spawn(|| walk(state))).collect();
        walk(first);
        handles.into_iter().for_each(|handle| handle.join().expect("a working thread panicked"));
    });
    line.order.into_inner().expect("no thread panics").failed.map_or(Ok(()), Err)
}

/// What the threads of [`in_order`] share.
struct Line<N, F, R> {
    /// The number of the next piece of work, and where it comes from.
    source: Mutex<(u64, N)>,
    order: Mutex<Order<R>>,
    moved: Condvar,
    finish: Mutex<F>,
    waiting_max: usize,
}

/// Results on their way to their end.
struct Order<R> {
    /// The number whose turn it is.
    next: u64,
    waiting: BTreeMap<u64, Result<R>>,
    is_finishing: bool,
    failed: Option<crate::Error>,
}

impl<R, N, F> Line<N, F, R> {
    /// Takes work until there is none left.
    fn walk<T>(&self, mut work: impl FnMut(T) -> Result<R>)
    where
        N: FnMut() -> Result<Option<T>>,
        F: FnMut(R) -> Result<()>,
    {
        loop {
            let (number, item) = {
                let mut source = self.source.lock().expect("no thread panics");
                if self.order().failed.is_some() {
                    return;
                }
                let item = source.1();
                source.0 += 1;
                (source.0 - 1, item)
            };
            let (result, is_last) = match item {
                Ok(Some(item)) => (work(item), false),
                Ok(None) => return,
                Err(error) => (Err(error), true),
            };
            let mut order = self.order();
            while order.waiting.len() >= self.waiting_max && order.next != number && order.failed.is_none() {
                order = self.moved.wait(order).expect("no thread panics");
            }
            order.waiting.insert(number, result);
            self.finish_those_whose_turn_it_is(order);
            if is_last {
                return;
            }
        }
    }

    fn order(&self) -> MutexGuard<'_, Order<R>> {
        self.order.lock().expect("no thread panics")
    }

    /// Finishes results as long as the next one is there, unless another thread is at it.
    fn finish_those_whose_turn_it_is<'a>(&'a self, mut order: MutexGuard<'a, Order<R>>)
    where
        F: FnMut(R) -> Result<()>,
    {
        while !order.is_finishing && order.failed.is_none() {
            let number = order.next;
            let Some(result) = order.waiting.remove(&number) else { return };
            order.is_finishing = true;
            drop(order);
            let result = result.and_then(|result| (self.finish.lock().expect("no thread panics"))(result));
            order = self.order();
            order.is_finishing = false;
            order.next += 1;
            if let Err(error) = result {
                order.failed = Some(error);
                order.waiting.clear();
            }
            self.moved.notify_all();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Error;

    /// Catches results that overtake each other, get lost, or pile up behind a slow one.
    #[test]
    fn results_keep_their_order() {
        let mut numbers = 0..2000_u64;
        let mut seen = Vec::new();
        in_order(
            &mut [0_u64; 5],
            || Ok(numbers.next()),
            |sum, number| {
                *sum += number;
                if number % 97 == 0 {
                    std::thread::sleep(std::time::Duration::from_millis(1));
                }
                Ok(number)
            },
            |number| {
                seen.push(number);
                Ok(())
            },
        )
        .unwrap();
        assert_eq!(seen, (0..2000).collect::<Vec<_>>());
    }

    /// Catches an error that depends on which thread is faster, and threads that go on after it.
    #[test]
    fn the_first_error_wins() {
        for source_fails in [false, true] {
            let (mut numbers, mut seen) = (0..10_000_u64, Vec::new());
            let error = in_order(
                &mut [(); 4],
                || match numbers.next() {
                    Some(700) if source_fails => Err(Error::invalid("700")),
                    number => Ok(number),
                },
                |(), number| match number {
                    700 | 701 | 705 => Err(Error::invalid(number.to_string())),
                    _ => Ok(number),
                },
                |number| {
                    seen.push(number);
                    Ok(())
                },
            )
            .unwrap_err();
            assert_eq!(error.message(), "700");
            assert_eq!(seen, (0..700).collect::<Vec<_>>());
            assert!(numbers.start < 9000, "work went on");
        }
    }
}
