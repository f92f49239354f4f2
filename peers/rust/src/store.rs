//! E-stops that are open, written down: they outlive the process.

use crate::wire::{decode, encode, is_chunk, Estop};
use std::fs;
use std::io;
use std::path::PathBuf;

/// A folder with a file for each, named by its id.
pub struct Store(pub PathBuf);

impl Store {
    /// All of them. A note that cannot be read is of an e-stop all the same.
    pub fn read(&self) -> io::Result<Vec<Estop>> {
        fs::create_dir_all(&self.0)?;
        let mut found = vec![];
        for file in fs::read_dir(&self.0)? {
            let file = file?;
            let Some(id) = file.file_name().to_str().filter(|id| is_chunk(id)).map(str::to_owned) else { continue };
            let told = decode(&fs::read(file.path())?).as_ref().and_then(Estop::read).filter(|one| one.id == id);
            let unread = || Estop {
                id,
                by: "unknown/".into(),
                reason: "its note cannot be read".into(),
                at: 0.0,
                told_by: String::new(),
            };
            found.push(told.unwrap_or_else(unread));
        }
        Ok(found)
    }

    pub fn write(&self, estop: &Estop) -> io::Result<()> {
        let fresh = self.0.join(format!("@{}", estop.id)); // no id begins so
        fs::write(&fresh, encode(&estop.value()))?;
        fs::File::open(&fresh)?.sync_all()?;
        fs::rename(fresh, self.0.join(&estop.id))?;
        fs::File::open(&self.0)?.sync_all()
    }

    pub fn remove(&self, id: &str) -> io::Result<()> {
        match fs::remove_file(self.0.join(id)) {
            Err(bad) if bad.kind() != io::ErrorKind::NotFound => Err(bad),
            _ => Ok(()),
        }
    }
}
