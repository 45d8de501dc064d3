//! Latched pieces, and which of them are forgotten.
//!
//! `pieces/image` and `pieces/features` are latched, so that a node that was started again hears all pieces. After a reset
//! it must not hear the earlier ones, but a writer can't take back what it has latched: DDS disposes of instances,
//! which a topic without key has none of. So a node that forgets its pieces says so: on `pieces/forgotten`, latched as well,
//! how many messages of its writer are void; when it starts it says *none*. Readers pass over what is void.
//!
//! A reader that comes late may hear pieces before that word. It keeps them back until the word has come, if discovery
//! shows that their participant has it to say: announcements come in order, and that of the word goes ahead of that of the pieces.
//! Nodes of others, which know nothing of this, are heard at once. The word names the writer, so that one that was
//! recorded means nothing when it is played.

use std::cell::Cell;
use std::collections::{HashMap, HashSet, VecDeque};
use std::rc::Rc;
use std::time::{Duration, Instant};

use futures::channel::mpsc;
use futures::{FutureExt, SinkExt, StreamExt};
use jigsaw_msgs::Message;
use jigsaw_msgs::msg::PiecesForgotten;
use rustdds::GUID;

use super::discovery::Audience;
use super::session::{CHANNEL_DEPTH, Session, SessionError};
use super::topics::{self, Topic};

/// How long pieces are kept back: far longer than the word takes that was sent ahead of them.
const PATIENCE: Duration = Duration::from_secs(1);

/// The publisher's side: says which pieces are void.
#[derive(Debug, Clone)]
pub struct Forgetting {
    writer: GUID,
    written: Rc<Cell<u64>>,
    words: mpsc::Sender<PiecesForgotten>,
}

impl Forgetting {
    /// All pieces published so far are forgotten.
    pub fn forget(&self) {
        let word = PiecesForgotten { writer: self.writer.to_bytes(), messages: self.written.get() };
        // Each sender has a place of its own in the channel, so that a new one never finds it full.
        let _ = self.words.clone().try_send(word);
    }
}

impl Session {
    /// A sink to a topic of latched pieces, who listens, and the means to forget what was sent.
    ///
    /// # Errors
    /// As for [`Session::subscribe`].
    pub fn publish_kept<M: Message>(
        &mut self,
        topic: &Topic<M>,
    ) -> Result<(mpsc::Sender<M>, Audience, Forgetting), SessionError> {
        // Opened first, so that it is announced first.
        let (words, _) = self.publish(&topics::PIECES_FORGOTTEN)?;
        let written = Rc::new(Cell::new(0));
        let counter = Rc::clone(&written);
        let (pieces, audience) = self.publish_counted(topic, move || counter.set(counter.get() + 1))?;
        let forgetting = Forgetting { writer: audience.writer(), written, words };
        forgetting.forget();
        Ok((pieces, audience, forgetting))
    }

    /// The messages of a topic of latched pieces that are not forgotten, and which writer each is from.
    ///
    /// # Errors
    /// As for [`Session::subscribe`].
    pub fn subscribe_kept<M: Message>(&mut self, topic: &Topic<M>) -> Result<mpsc::Receiver<(M, GUID)>, SessionError> {
        let origin = |info: &ros2_client::MessageInfo| Origin {
            writer: info.publisher_gid().into(),
            number: u64::try_from(info.sequence_number()).unwrap_or_default(),
        };
        let mut words = self.subscribe_as(&topics::PIECES_FORGOTTEN, move |word, info| (word, origin(&info)))?;
        let mut pieces = self.subscribe_to_all_as(topic, move |piece, info| (piece, origin(&info)))?;
        let announced = self.writers_of(&topics::PIECES_FORGOTTEN)?;
        let (mut sender, receiver) = mpsc::channel(CHANNEL_DEPTH);
        self.spawn(async move {
            let mut passage = Passage::default();
            loop {
                let due = passage.held.front().map(|held| held.until);
                let mut alarm = FutureExt::fuse(due.map_or_else(smol::Timer::never, smol::Timer::at));
                let mut free = Vec::new();
                futures::select_biased! {
                    word = words.next() => if let Some((word, origin)) = word {
                        free = passage.hear(&word, participant(origin.writer));
                    },
                    piece = pieces.next() => match piece {
                        Some((piece, origin)) => {
                            let has_a_word = |by| announced().iter().any(|&writer| participant(writer) == by);
                            free.extend(passage.offer(piece, origin, has_a_word, Instant::now()));
                        }
                        None => break,
                    },
                    _ = alarm => free = passage.give_up(Instant::now()),
                }
                for (piece, writer) in free {
                    if sender.send((piece, writer)).await.is_err() {
                        return;
                    }
                }
            }
        });
        Ok(receiver)
    }
}

/// The first part of a GUID, which the writers of a participant have in common.
type Participant = [u8; 12];

fn participant(writer: GUID) -> Participant {
    std::array::from_fn(|k| writer.to_bytes()[k])
}

/// Which message this is.
#[derive(Debug, Clone, Copy)]
struct Origin {
    writer: GUID,
    /// Counted from 1.
    number: u64,
}

/// A piece that waits for the word of its participant.
#[derive(Debug)]
struct Held<M> {
    piece: M,
    origin: Origin,
    until: Instant,
}

/// What lets pieces through.
#[derive(Debug)]
struct Passage<M> {
    /// Messages that are void, by their writer.
    void: HashMap<GUID, u64>,
    /// Participants that have spoken, or have no word to say.
    settled: HashSet<Participant>,
    held: VecDeque<Held<M>>,
}

impl<M> Default for Passage<M> {
    fn default() -> Self {
        Self { void: HashMap::new(), settled: HashSet::new(), held: VecDeque::new() }
    }
}

impl<M> Passage<M> {
    /// Takes a participant's word; gives what need wait no longer.
    fn hear(&mut self, word: &PiecesForgotten, by: Participant) -> Vec<(M, GUID)> {
        let writer = GUID::from_bytes(word.writer);
        // Nobody speaks for others.
        if participant(writer) == by {
            self.void.insert(writer, word.messages);
        }
        self.settle(by)
    }

    /// A piece has come: gives it back unless it is void, or is to wait.
    fn offer(
        &mut self,
        piece: M,
        origin: Origin,
        has_a_word: impl FnOnce(Participant) -> bool,
        now: Instant,
    ) -> Option<(M, GUID)> {
        let by = participant(origin.writer);
        if !self.settled.contains(&by) {
            if has_a_word(by) {
                self.held.push_back(Held { piece, origin, until: now + PATIENCE });
                return None;
            }
            self.settled.insert(by);
        }
        self.valid(origin).then_some((piece, origin.writer))
    }

    /// The time of the oldest pieces is up: gives them, and all others of their participants.
    fn give_up(&mut self, now: Instant) -> Vec<(M, GUID)> {
        let mut free = Vec::new();
        while let Some(held) = self.held.front().filter(|held| held.until <= now) {
            free.extend(self.settle(participant(held.origin.writer)));
        }
        free
    }

    fn settle(&mut self, by: Participant) -> Vec<(M, GUID)> {
        self.settled.insert(by);
        let held = std::mem::take(&mut self.held);
        let (mine, others): (VecDeque<_>, _) = held.into_iter().partition(|held| participant(held.origin.writer) == by);
        self.held = others;
        mine.into_iter().filter(|held| self.valid(held.origin)).map(|held| (held.piece, held.origin.writer)).collect()
    }

    fn valid(&self, origin: Origin) -> bool {
        self.void.get(&origin.writer).is_none_or(|&void| origin.number > void)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn writer(participant: u8) -> GUID {
        GUID::from_bytes([participant; 16])
    }

    fn word(participant: u8, messages: u64) -> PiecesForgotten {
        PiecesForgotten { writer: writer(participant).to_bytes(), messages }
    }

    /// Offers messages of these numbers; gives the numbers that pass.
    fn offered(
        passage: &mut Passage<u64>,
        participant: u8,
        numbers: std::ops::Range<u64>,
        has_a_word: bool,
    ) -> Vec<u64> {
        let passed = numbers.filter_map(|number| {
            let origin = Origin { writer: writer(participant), number };
            passage.offer(number, origin, |_| has_a_word, Instant::now())
        });
        passed.map(|(number, _)| number).collect()
    }

    fn numbers(free: Vec<(u64, GUID)>) -> Vec<u64> {
        free.into_iter().map(|(number, _)| number).collect()
    }

    #[test]
    fn what_is_forgotten_is_passed_over_whatever_comes_first() {
        let mut late = Passage::default();
        assert!(offered(&mut late, 1, 1..6, true).is_empty(), "the word is still to come");
        assert_eq!(numbers(late.hear(&word(1, 3), participant(writer(1)))), [4, 5]);
        assert_eq!(offered(&mut late, 1, 6..8, true), [6, 7]);

        let mut early = Passage::default();
        assert!(early.hear(&word(1, 0), participant(writer(1))).is_empty());
        assert_eq!(offered(&mut early, 1, 1..3, true), [1, 2]);
        early.hear(&word(1, 3), participant(writer(1)));
        assert_eq!(offered(&mut early, 1, 3..5, true), [4]);
    }

    #[test]
    fn nodes_that_know_nothing_of_it_are_heard_at_once() {
        let mut passage = Passage::default();
        assert_eq!(offered(&mut passage, 2, 1..4, false), [1, 2, 3]);
    }

    #[test]
    fn a_participant_speaks_for_itself_alone() {
        let mut passage = Passage::default();
        assert!(offered(&mut passage, 1, 1..3, true).is_empty());
        // As a bag does that is played: it tells of a writer that was another participant's.
        assert!(passage.hear(&word(1, 2), participant(writer(3))).is_empty());
        assert_eq!(numbers(passage.hear(&word(1, 0), participant(writer(1)))), [1, 2]);
    }

    #[test]
    fn a_word_that_does_not_come_is_not_waited_for_long() {
        let mut passage = Passage::default();
        assert!(offered(&mut passage, 1, 1..3, true).is_empty());
        assert!(passage.give_up(Instant::now()).is_empty());
        assert_eq!(numbers(passage.give_up(Instant::now() + PATIENCE)), [1, 2]);
        assert_eq!(offered(&mut passage, 1, 3..4, true), [3]);
    }
}
