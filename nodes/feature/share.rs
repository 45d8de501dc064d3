//! Several feature nodes that share the pieces.
//!
//! Every node hears every piece and every result. For each piece the nodes are ranked by rendezvous hashing (Thaler and
//! Ravishankar 1998): all of them come to the same order without a word. The first works on the piece at once; the others
//! keep it until the result is heard, and the second takes it over where none comes in time, and so on. A node whose share
//! had to be taken over ranks last until it is heard again, so that a dead node delays only the pieces that were under
//! way. A node also keeps the results of the others, and publishes those of a node that has gone or is silent: whoever comes
//! later, or has not heard them before, finds all pieces all the same.
//!
//! A piece that two nodes work on does no harm: the solver knows it by its content. `O(n)` for `n` nodes a piece.

use std::collections::{HashMap, HashSet};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::time::{Duration, Instant};

use futures::channel::mpsc;
use futures::{SinkExt, Stream, StreamExt};
use jigsaw_msgs::msg::{PieceFeatures, PieceImage};
use jigsaw_msgs::std_msgs::msg::Empty;
use rustdds::GUID;

/// How long the first of the ranked nodes has for a piece before the next takes it over: hundreds of times what a piece
/// takes, so that a node that is only busy keeps its share.
const PATIENCE: Duration = Duration::from_secs(1);

/// How often is looked whether a node has gone.
const LOOK_PERIOD: Duration = Duration::from_millis(200);

/// Pieces that are kept for others, and results of others; as many as are latched.
const MOST_KEPT: usize = 1024;

/// The writer of a node's results stands for the node.
type Member = [u8; 16];

/// A piece that another node should work on.
#[derive(Debug)]
struct Waiting {
    piece: PieceImage,
    owner: Member,
    until: Instant,
}

/// What a node knows of the others' work.
#[derive(Debug)]
pub struct Share {
    own: Member,
    waiting: HashMap<String, Waiting>,
    results: HashMap<String, (Member, PieceFeatures)>,
    silent: HashSet<Member>,
}

impl Share {
    /// Of the node whose results come from this writer.
    pub fn new(own: GUID) -> Self {
        Self { own: own.to_bytes(), waiting: HashMap::new(), results: HashMap::new(), silent: HashSet::new() }
    }

    /// All pieces are forgotten: nothing that others have found is of use any more.
    pub fn forget(&mut self) {
        self.waiting.clear();
        self.results.clear();
    }

    /// The nodes in the order in which a piece falls to them.
    fn ranked(&self, piece: &str, others: &[GUID]) -> Vec<Member> {
        let mut members: Vec<Member> = others.iter().map(|other| other.to_bytes()).chain([self.own]).collect();
        members.sort_by_cached_key(|member| {
            let mut hasher = DefaultHasher::new();
            (piece, member).hash(&mut hasher);
            (self.silent.contains(member), hasher.finish(), *member)
        });
        members
    }

    /// A piece has come: gives it back if it is to be worked on now.
    pub fn offer(&mut self, piece: PieceImage, others: &[GUID], now: Instant) -> Option<PieceImage> {
        let ranked = self.ranked(&piece.id, others);
        let rank = ranked.iter().position(|&member| member == self.own).unwrap_or_default();
        if rank == 0 || self.waiting.len() >= MOST_KEPT {
            return Some(piece);
        }
        let until = now + PATIENCE * u32::try_from(rank).unwrap_or(u32::MAX);
        self.waiting.insert(piece.id.clone(), Waiting { piece, owner: ranked[0], until });
        None
    }

    /// Another node has published a result.
    pub fn heard(&mut self, result: PieceFeatures, by: GUID) {
        let by = by.to_bytes();
        if by == self.own {
            return;
        }
        self.silent.remove(&by);
        self.waiting.remove(&result.id);
        if self.results.len() < MOST_KEPT || self.results.contains_key(&result.id) {
            self.results.insert(result.id.clone(), (by, result));
        }
    }

    /// The pieces whose node had its time; they are now this node's.
    pub fn overdue(&mut self, now: Instant) -> Vec<PieceImage> {
        let ids: Vec<String> = self.waiting.iter().filter(|(_, w)| w.until <= now).map(|(id, _)| id.clone()).collect();
        let mut pieces = Vec::new();
        for waiting in ids.iter().filter_map(|id| self.waiting.remove(id)) {
            if self.silent.insert(waiting.owner) {
                log::warn!("a feature node does not answer; its share of the pieces is taken over");
            }
            pieces.push(waiting.piece);
        }
        // Those that wait for the same node need not wait longer.
        let of_silent = self.waiting.values_mut().filter(|w| self.silent.contains(&w.owner));
        of_silent.for_each(|w| w.until = now);
        pieces
    }

    /// The results of nodes that have gone or are silent, where this node is the one to keep them for those who come later,
    /// and for those whom they have not reached yet.
    fn inherit(&mut self, others: &[GUID]) -> Vec<PieceFeatures> {
        let alive: HashSet<Member> = others.iter().map(|other| other.to_bytes()).collect();
        let silent = &self.silent;
        let gone = self.results.iter().filter(|(_, (by, _))| !alive.contains(by) || silent.contains(by));
        let ids: Vec<String> = gone.map(|(id, _)| id.clone()).collect();
        let mut mine = Vec::new();
        for id in ids {
            let first = self.ranked(&id, others)[0];
            if let Some((_, result)) = self.results.remove(&id)
                && first == self.own
            {
                mine.push(result);
            }
        }
        self.silent.retain(|member| alive.contains(member));
        mine
    }
}

/// What goes in and out of [`run`].
pub struct Streams<P, R> {
    /// All pieces.
    pub pieces: P,
    /// All results, and from whom.
    pub heard: mpsc::Receiver<(PieceFeatures, GUID)>,
    /// The solver has forgotten all pieces.
    pub resets: R,
    /// The pieces that this node is to work on.
    pub work: mpsc::Sender<PieceImage>,
    /// Where results of nodes that have gone are published again.
    pub results: mpsc::Sender<PieceFeatures>,
}

/// Takes from the pieces this node's share. Ends with the pieces.
pub async fn run(
    mut share: Share,
    streams: Streams<impl Stream<Item = PieceImage> + Unpin, impl Stream<Item = Empty> + Unpin>,
    others: impl Fn() -> Vec<GUID>,
) {
    let Streams { pieces, mut heard, resets, mut work, mut results } = streams;
    let (mut pieces, mut resets) = (pieces.fuse(), resets.fuse());
    let mut tick = StreamExt::fuse(smol::Timer::interval(LOOK_PERIOD));
    loop {
        let mut mine = Vec::new();
        futures::select_biased! {
            result = heard.next() => if let Some((result, by)) = result {
                share.heard(result, by);
            },
            reset = resets.next() => if reset.is_some() {
                share.forget();
            },
            piece = pieces.next() => match piece {
                Some(piece) => mine.extend(share.offer(piece, &others(), Instant::now())),
                None => break,
            },
            _ = tick.next() => {
                mine.extend(share.overdue(Instant::now()));
                for result in share.inherit(&others()) {
                    if results.send(result).await.is_err() {
                        return;
                    }
                }
            }
        }
        for piece in mine {
            if work.send(piece).await.is_err() {
                return;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn guid(k: u8) -> GUID {
        GUID::from_bytes([k; 16])
    }

    fn piece(id: usize) -> PieceImage {
        PieceImage { id: format!("piece{id}"), ..PieceImage::default() }
    }

    fn result(id: &str) -> PieceFeatures {
        PieceFeatures { id: id.to_owned(), ..PieceFeatures::default() }
    }

    /// The share of each of three nodes of these pieces.
    fn shares(nodes: &mut [Share], alive: &[u8], pieces: std::ops::Range<usize>, now: Instant) -> Vec<Vec<String>> {
        let mut all = Vec::new();
        for (k, node) in nodes.iter_mut().enumerate().filter(|(k, _)| alive.contains(&(*k as u8))) {
            let others: Vec<GUID> = (0..3).filter(|&other| other as usize != k).map(guid).collect();
            all.push(pieces.clone().filter_map(|id| node.offer(piece(id), &others, now)).map(|p| p.id).collect());
        }
        all
    }

    #[test]
    fn every_piece_falls_to_one_node_and_shares_are_fair() {
        let mut nodes: Vec<Share> = (0..3).map(|k| Share::new(guid(k))).collect();
        let all = shares(&mut nodes, &[0, 1, 2], 0..300, Instant::now());
        assert!(all.iter().all(|share| (60..140).contains(&share.len())));
        let together: HashSet<&String> = all.iter().flatten().collect();
        assert_eq!((together.len(), all.iter().map(Vec::len).sum::<usize>()), (300, 300));
    }

    #[test]
    fn the_share_of_a_silent_node_is_taken_over() {
        let mut nodes: Vec<Share> = (0..3).map(|k| Share::new(guid(k))).collect();
        let now = Instant::now();
        let served = shares(&mut nodes, &[0, 1], 0..300, now);
        for (k, share) in served.iter().enumerate() {
            share.iter().for_each(|id| nodes[1 - k].heard(result(id), guid(k as u8)));
        }
        assert!(nodes[0].overdue(now + PATIENCE / 2).is_empty());
        let late = now + 2 * PATIENCE;
        let mut taken: Vec<String> = (0..2).flat_map(|k| nodes[k].overdue(late)).map(|p| p.id).collect();
        taken.extend(served.into_iter().flatten());
        taken.sort();
        taken.dedup();
        assert_eq!(taken.len(), 300);
        // From now on its share is not waited for, until it is heard again.
        let without: usize = shares(&mut nodes, &[0, 1], 300..600, late).iter().map(Vec::len).sum();
        assert_eq!(without, 300);
        nodes[..2].iter_mut().for_each(|node| node.heard(result("sign of life"), guid(2)));
        let with: usize = shares(&mut nodes, &[0, 1], 600..900, late).iter().map(Vec::len).sum();
        assert!(with < 240);
    }

    #[test]
    fn the_results_of_a_node_that_has_gone_are_kept_by_one_other() {
        let mut nodes: Vec<Share> = (0..2).map(|k| Share::new(guid(k))).collect();
        for node in &mut nodes {
            (0..100).for_each(|id| node.heard(result(&format!("piece{id}")), guid(2)));
        }
        let [first, second] = &mut nodes[..] else { unreachable!() };
        assert!(first.inherit(&[guid(1), guid(2)]).is_empty());
        let kept = [first.inherit(&[guid(1)]), second.inherit(&[guid(0)])];
        assert_eq!(kept.iter().map(Vec::len).sum::<usize>(), 100);
        assert!(kept.iter().all(|share| share.len() > 20));
        assert!(first.inherit(&[guid(1)]).is_empty());
        // What was forgotten does not come back.
        first.heard(result("of an earlier puzzle"), guid(2));
        first.forget();
        assert!(first.inherit(&[]).is_empty());
    }

    #[test]
    fn what_a_silent_node_has_published_is_published_again() {
        let mut node = Share::new(guid(0));
        let (others, now) = ([guid(1)], Instant::now());
        node.heard(result("heard"), guid(1));
        let left = (0..).map(piece).find(|piece| node.offer(piece.clone(), &others, now).is_none()).unwrap();
        assert!(node.inherit(&others).is_empty());
        assert_eq!(node.overdue(now + 2 * PATIENCE), [left]);
        assert_eq!(node.inherit(&others), [result("heard")]);
    }
}
