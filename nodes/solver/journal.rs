//! The pieces that the node has taken in, kept in a folder, so that they outlast the process.
//!
//! A node that is started again hears the latched `pieces/features` of the feature node. But where the feature node, and
//! the capture node before it, were started again since the camera showed the pieces, nobody has them any more. So each
//! piece that is taken is written to a file of its own: beside its place and then renamed, so that an end at any point
//! leaves whole files only. They are not forced to the disk: a journal outlasts a process, not a power failure, and a file
//! that was damaged is known by its checksum.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::io::Write;
use std::path::{Path, PathBuf};

use byteorder::LittleEndian;
use jigsaw_msgs::msg::PieceFeatures;

/// Bytes of the checksum (CRC-32, little endian) at the end of a file.
const CHECKSUM: usize = 4;

/// Ending of the files of a journal; others in the folder are left alone.
const ENDING: &str = "piece";

/// Why a journal can't be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum JournalError {
    /// The system refuses.
    #[error("journal '{}': {reason}", path.display())]
    Io {
        /// File or folder.
        path: PathBuf,
        /// The system's words.
        reason: String,
    },
    /// A file holds no piece.
    #[error("journal '{}': must hold one piece: {reason}", path.display())]
    Damaged {
        /// File.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
}

impl JournalError {
    fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.to_owned();
        move |e| Self::Io { path, reason: e.to_string() }
    }
}

/// A folder with a file for each piece.
#[derive(Debug, Clone)]
pub struct Journal {
    folder: PathBuf,
}

impl Journal {
    /// Opens a journal; the folder is made where it is missing.
    ///
    /// # Errors
    /// A folder that can be neither read nor made.
    pub fn open(folder: &Path) -> Result<Self, JournalError> {
        std::fs::create_dir_all(folder).map_err(JournalError::io(folder))?;
        let journal = Self { folder: folder.to_owned() };
        journal.files()?;
        Ok(journal)
    }

    fn files(&self) -> Result<Vec<PathBuf>, JournalError> {
        let entries = std::fs::read_dir(&self.folder).map_err(JournalError::io(&self.folder))?;
        let mut files: Vec<PathBuf> = entries
            .flatten()
            .map(|entry| entry.path())
            .filter(|path| path.extension().is_some_and(|ending| ending == ENDING))
            .collect();
        files.sort();
        Ok(files)
    }

    /// The pieces kept, and the files that hold none.
    ///
    /// # Errors
    /// A folder that can't be read.
    pub fn pieces(&self) -> Result<(Vec<PieceFeatures>, Vec<JournalError>), JournalError> {
        let (mut pieces, mut faults) = (Vec::new(), Vec::new());
        for path in self.files()? {
            match read(&path) {
                Ok(piece) => pieces.push(piece),
                Err(fault) => faults.push(fault),
            }
        }
        // Names of files are hashes; the pieces come in the order in which they were seen.
        pieces.sort_by(|a, b| {
            let key = |p: &PieceFeatures| (p.header.stamp.sec, p.header.stamp.nanosec, p.id.clone());
            key(a).cmp(&key(b))
        });
        Ok((pieces, faults))
    }

    /// Keeps a piece.
    ///
    /// # Errors
    /// The system's refusal to write.
    pub fn keep(&self, piece: &PieceFeatures) -> Result<(), JournalError> {
        let path = self.path(&piece.id);
        let damaged = |reason: String| JournalError::Damaged { path: path.clone(), reason };
        let mut bytes = cdr_encoding::to_vec::<_, LittleEndian>(piece).map_err(|e| damaged(e.to_string()))?;
        bytes.extend(crc32fast::hash(&bytes).to_le_bytes());
        let mut file = tempfile::NamedTempFile::new_in(&self.folder).map_err(JournalError::io(&path))?;
        file.write_all(&bytes).map_err(JournalError::io(&path))?;
        file.persist(&path).map_err(|e| JournalError::io(&path)(e.error))?;
        Ok(())
    }

    /// Forgets a piece.
    ///
    /// # Errors
    /// The system's refusal to remove it.
    pub fn forget(&self, id: &str) -> Result<(), JournalError> {
        remove(&self.path(id))
    }

    /// Forgets all pieces.
    ///
    /// # Errors
    /// The system's refusal to remove one; the others are removed.
    pub fn forget_all(&self) -> Result<(), JournalError> {
        self.files()?.iter().map(|path| remove(path)).fold(Ok(()), Result::and)
    }

    /// The file of a piece. Ids may be too long for a name and hold what a name can't; the piece itself tells its id.
    fn path(&self, id: &str) -> PathBuf {
        let mut hasher = DefaultHasher::new();
        id.hash(&mut hasher);
        self.folder.join(format!("{:016x}.{ENDING}", hasher.finish()))
    }
}

fn read(path: &Path) -> Result<PieceFeatures, JournalError> {
    let bytes = std::fs::read(path).map_err(JournalError::io(path))?;
    let damaged = |reason: String| JournalError::Damaged { path: path.to_owned(), reason };
    let (bytes, checksum) =
        bytes.split_last_chunk::<CHECKSUM>().ok_or_else(|| damaged("it is too short".to_owned()))?;
    if crc32fast::hash(bytes) != u32::from_le_bytes(*checksum) {
        return Err(damaged("its checksum is another".to_owned()));
    }
    let (piece, _) =
        cdr_encoding::from_bytes::<PieceFeatures, LittleEndian>(bytes).map_err(|e| damaged(e.to_string()))?;
    Ok(piece)
}

fn remove(path: &Path) -> Result<(), JournalError> {
    match std::fs::remove_file(path) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(JournalError::io(path)(e)),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn piece(id: &str, sec: i32) -> PieceFeatures {
        let mut piece = PieceFeatures { id: id.to_owned(), border_x_px: vec![1.5; 100], ..PieceFeatures::default() };
        piece.header.stamp.sec = sec;
        piece
    }

    #[test]
    fn pieces_outlast_the_journal() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("made/here");
        let journal = Journal::open(&path).unwrap();
        let long = "ä".repeat(100);
        for (id, sec) in [("..", 3), (&long, 1), ("a", 2), ("a", 2)] {
            journal.keep(&piece(id, sec)).unwrap();
        }
        let (pieces, faults) = Journal::open(&path).unwrap().pieces().unwrap();
        assert_eq!(pieces, [piece(&long, 1), piece("a", 2), piece("..", 3)]);
        assert!(faults.is_empty());
        journal.forget("a").unwrap();
        journal.forget("never seen").unwrap();
        assert_eq!(journal.pieces().unwrap().0.len(), 2);
        journal.forget_all().unwrap();
        assert!(journal.pieces().unwrap().0.is_empty());
    }

    #[test]
    fn damage_is_told_and_the_rest_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let journal = Journal::open(folder.path()).unwrap();
        journal.keep(&piece("a", 1)).unwrap();
        let whole = std::fs::read(journal.path("a")).unwrap();
        let other = folder.path().join("other.piece");
        std::fs::write(folder.path().join("notes.txt"), "not a piece").unwrap();
        let check = |damaged: &[u8], what: &str| {
            std::fs::write(&other, damaged).unwrap();
            let (pieces, faults) = journal.pieces().unwrap();
            assert_eq!((pieces, faults.len()), (vec![piece("a", 1)], 1), "{what}");
            assert!(
                matches!(&faults[0], JournalError::Damaged { path, .. } if *path == other),
                "{what}: {}",
                faults[0]
            );
        };
        check(&[&whole[..], &[0; 8]].concat(), "bytes at the end");
        for at in 0..whole.len() {
            check(&whole[..at], &format!("cut after {at} bytes"));
            let mut changed = whole.clone();
            changed[at] ^= 1 << (at % 8);
            check(&changed, &format!("a bit of byte {at} changed"));
        }
        journal.forget_all().unwrap();
        assert!(folder.path().join("notes.txt").exists());
        let file = folder.path().join("notes.txt");
        assert!(matches!(Journal::open(&file), Err(JournalError::Io { .. })));
    }
}
